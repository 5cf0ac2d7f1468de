"""POV-Ray as a referee: a Lambertian glTF scene under a soft dome, one EXR a replicate.

    python povray.py SCENE DOME FOLDER [options]

The dome is a sky sphere (nearest texel), its light is gathered by radiosity with one bounce and no reuse. POV-Ray draws
the same directions everywhere and does not seek out what is bright: every replicate has the whole world turned at random
and its camera moved inside the pixel, and hard suns are not for it. Skins and textures are refused.
"""

import argparse
import os
import subprocess
import tempfile

import numpy as np

import gltf

SCENE = """#version 3.7;
global_settings {{ assumed_gamma 1 max_trace_level 2
  radiosity {{ pretrace_start 1 pretrace_end 1 count {count},{pool} nearest_count 1 error_bound 1e-5 recursion_limit 1
    low_error_factor 1 gray_threshold 0 minimum_reuse 1e-6 maximum_reuse 2e-6 brightness 1 always_sample on normal on }} }}
#default {{ finish {{ ambient 0 emission 0 diffuse 1 }} }}
#include "geometry.inc"
sky_sphere {{ pigment {{ image_map {{ exr "{dome}" map_type 1 }} scale <-1, 1, 1> }} emission 1 {world} }}
camera {{ perspective location {eye} right {right} up {up} direction {direction} }}
"""

# POV-Ray's axes are left-handed: z is turned round.
FLIP = np.diag([1.0, 1.0, -1.0])


def main():
    parser = argparse.ArgumentParser(prog="povray.py", description=__doc__.split("\n")[0])
    parser.add_argument("--spp", type=int, default=32, help="rays a pixel and replicate (radiosity's count)")
    options = gltf.arguments(parser, None)
    meshes = list(triangles(options.asset))
    for replicate in range(options.replicates):
        render(options, meshes, np.random.default_rng(replicate), os.path.join(options.folder, f"{replicate}.exr"))
    version = subprocess.run(["povray", "--version"], capture_output=True, text=True)
    words = (version.stdout + version.stderr).split()
    with open(os.path.join(options.folder, "tool.txt"), "w") as out:
        out.write("POV-Ray " + next(w for w in words if w[0].isdigit() and w.count(".") >= 2))


def triangles(asset):
    """(positions, normals or None, indices, colour) of all that is shown, in world space."""
    for node, world in asset.nodes():
        if "skin" in node:
            raise SystemExit("skins are not mapped here")
        for primitive in asset.list("meshes")[node["mesh"]]["primitives"] if "mesh" in node else []:
            attributes = primitive["attributes"]
            positions = asset.accessor(attributes["POSITION"]) @ world[:3, :3].T + world[:3, 3]
            normals = None
            if "NORMAL" in attributes:
                normals = asset.accessor(attributes["NORMAL"]) @ np.linalg.inv(world[:3, :3])
                normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            yield positions, normals, asset.accessor(primitive["indices"]).reshape(-1, 3), colour(asset, primitive)


def colour(asset, primitive):
    """The albedo of a Lambertian material."""
    material = asset.list("materials")[primitive["material"]]
    pbr = material.get("pbrMetallicRoughness", {})
    gloss = material.get("extensions", {}).get("KHR_materials_specular", {}).get("specularFactor", 1)
    if gloss or pbr.get("metallicFactor", 1) or "baseColorTexture" in pbr or material.get("alphaMode", "OPAQUE") != "OPAQUE":
        raise SystemExit("only Lambertian materials of one colour are mapped here")
    return pbr.get("baseColorFactor", [1, 1, 1, 1])[:3]


def render(options, meshes, random, out):
    turn = FLIP @ rotation(random)
    vector = lambda v: "<%.9g,%.9g,%.9g>" % tuple(v)
    eye, right, up, back, fov = options.camera
    wide = 2 * np.tan(fov / 2)
    shift = (random.random(2) - 0.5) * wide / options.size
    # In POV-Ray's axes before and after the turn; the sky is defined in those before.
    world = turn @ FLIP
    matrix = "matrix <%s, 0,0,0>" % ",".join("%.9g" % v for v in world.T.ravel())
    with tempfile.TemporaryDirectory() as folder:
        with open(os.path.join(folder, "geometry.inc"), "w") as file:
            for positions, normals, indices, albedo in meshes:
                lists = [("vertex_vectors", positions @ turn.T)]
                if normals is not None:
                    lists.append(("normal_vectors", normals @ turn.T))
                file.write("mesh2 {\n")
                for name, values in lists:
                    file.write(f"{name} {{ {len(values)}, {','.join(map(vector, values.tolist()))} }}\n")
                faces = ",".join("<%d,%d,%d>" % tuple(t) for t in indices.tolist())
                file.write(f"face_indices {{ {len(indices)}, {faces} }}\npigment {{ rgb {vector(albedo)} }} }}\n")
        with open(os.path.join(folder, "scene.pov"), "w") as file:
            file.write(SCENE.format(
                count=options.spp, pool=max(1600, 16 * options.spp), dome=os.path.abspath(options.dome), world=matrix,
                eye=vector(turn @ eye), right=vector(turn @ right * wide), up=vector(turn @ up * wide),
                direction=vector(turn @ (shift[0] * right + shift[1] * up - back))))
        size = [f"+W{options.size}", f"+H{options.size}"]
        run = ["povray", "scene.pov", "+Oout.exr", "+FE", *size, "-D", "-A"]
        done = subprocess.run(run, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr[-2000:])
        os.replace(os.path.join(folder, "out.exr"), out)


def rotation(random):
    """A rotation, all equally likely."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


main()
