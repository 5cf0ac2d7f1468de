"""Cycles as a referee: a glTF scene under a dome, direct light only, one EXR a seed.

    python cycles.py SCENE DOME FOLDER [options]               where the package bpy (4.3 or newer) is installed
    blender -b -P cycles.py -- SCENE DOME FOLDER [options]     Debian's 3.4: Lambertian scenes alone

Geometry comes in through Blender's importer; materials are built here as glTF means them, out of closures that Cycles
evaluates exactly: Lambert's, and single-scattering GGX with Schlick's Fresnel (the Metallic node with a white edge tint).
Left out, since no closure has it: the dimming of the diffuse lobe by the dielectric's gloss above it. Emission is seen
by the camera and lights nothing. Nothing is clamped, denoised, adaptive or filtered; the dome is looked up per texel.
"""

import argparse
import math
import os
import sys
import tempfile

# Blender's own add-on is called `cycles` too, and this folder must not hide it.
HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:] = [p for p in sys.path if os.path.abspath(p or ".") != HERE]
import bpy
import numpy as np
from mathutils import Matrix

sys.path.append(HERE)
import gltf

sys.path.remove(HERE)

# The importer of Debian's Blender 3.4 asks its numpy 1.24 for a name that is no more.
if "bool" not in vars(np):
    np.bool = bool

# glTF's +Y up to Blender's +Z up.
TURN = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)


def main():
    argv = sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(prog="cycles.py", description=__doc__.split("\n")[0])
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel and seed")
    options = gltf.arguments(parser, argv)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with tempfile.TemporaryDirectory() as temporary:
        geometry(options.asset, temporary)
        materials(options.asset, temporary)
    camera(options.camera)
    world(options.dome)
    render(options)


def geometry(asset, folder):
    """Imports everything but the materials, whose names become their numbers."""
    bare = gltf.Asset.__new__(gltf.Asset)
    bare.json, bare.buffers = dict(asset.json), asset.buffers
    for name in ("images", "textures", "samplers", "animations", "cameras", "extensionsRequired", "extensionsUsed"):
        bare.json.pop(name, None)
    count = len(asset.list("materials"))
    bare.json["materials"] = [{"name": f"material{i}"} for i in range(count + 1)]
    for mesh in bare.list("meshes"):
        for primitive in mesh["primitives"]:
            # The last one is glTF's default material.
            primitive.setdefault("material", count)
    bare.json["nodes"] = [{k: v for k, v in n.items() if k not in ("camera", "extensions")} for n in asset.list("nodes")]
    path = os.path.join(folder, "bare.glb")
    bare.save_glb(path)
    bpy.ops.import_scene.gltf(filepath=path)
    for thing in bpy.data.objects:
        if thing.type == "MESH":
            for name in ("shading_offset", "normal_offset", "offset", "geometry_offset"):
                switch(thing, f"shadow_terminator_{name}", 0)
        # The importer draws bones as icospheres; they are not to be rendered.
        if any(c.name.startswith("glTF_not_exported") for c in thing.users_collection):
            thing.hide_render = True


def switch(thing, name, value):
    """Sets what is a property of the thing, of its Cycles part, or of neither, by Blender's version."""
    for owner in (thing, getattr(thing, "cycles", None)):
        if owner is not None and hasattr(owner, name):
            setattr(owner, name, value)


def materials(asset, folder):
    definitions = asset.list("materials") + [{}]
    for material in bpy.data.materials:
        if material.name.startswith("material"):
            Builder(asset, definitions[int(material.name[8:].split(".")[0])], material, folder).build()


class Builder:
    """The nodes of one material."""

    def __init__(self, asset, definition, material, folder):
        self.asset, self.definition, self.folder = asset, definition, folder
        material.use_nodes = True
        switch(material, "use_bump_map_correction", False)
        switch(material, "emission_sampling", "NONE")
        self.tree = material.node_tree
        self.tree.nodes.clear()

    def node(self, kind, inputs=(), **properties):
        node = self.tree.nodes.new("ShaderNode" + kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for key, value in dict(inputs).items():
            self.set(node.inputs[key], value)
        return node

    def set(self, socket, value):
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif socket.type == "RGBA":
            socket.default_value = [*value, 1.0] if hasattr(value, "__len__") else [value] * 3 + [1.0]
        else:
            socket.default_value = value

    def math(self, operation, a, b):
        if not isinstance(a, bpy.types.NodeSocket) and not isinstance(b, bpy.types.NodeSocket):
            return {"MULTIPLY": a * b, "SUBTRACT": a - b}[operation]
        return self.node("Math", {0: a, 1: b}, operation=operation).outputs[0]

    def times(self, colour, by):
        """A colour times a colour or number, channel by channel, unclamped."""
        plain = lambda v: not isinstance(v, bpy.types.NodeSocket)
        wide = lambda v: [v] * 3 if plain(v) and not hasattr(v, "__len__") else v
        colour, by = wide(colour), wide(by)
        if plain(colour) and plain(by):
            return [a * b for a, b in zip(colour, by)]
        return self.node("VectorMath", {0: colour, 1: by}, operation="MULTIPLY").outputs[0]

    def image(self, reference, what):
        """A texture's `what` (colour: decoded, linear; data; a channel 0–3): its socket. Filtered after it is decoded,
        which Cycles' own byte textures are not."""
        if "KHR_texture_transform" in reference.get("extensions", {}):
            raise SystemExit("KHR_texture_transform is not mapped here")
        texture = self.asset.json["textures"][reference["index"]]
        path = os.path.join(self.folder, str(texture["source"]))
        if not os.path.exists(path):
            open(path, "wb").write(self.asset.image(texture["source"]))
        key = f"{texture['source']} {what} {reference.get('scale', 1)}"
        image = bpy.data.images.get(key)
        if image is None:
            source = bpy.data.images.load(path)
            source.alpha_mode = "CHANNEL_PACKED"
            source.colorspace_settings.name = "Non-Color"
            width, height = source.size
            pixels = np.empty(width * height * 4, np.float32)
            source.pixels.foreach_get(pixels)
            bpy.data.images.remove(source)
            pixels = pixels.reshape(-1, 4).astype(float)
            if isinstance(what, int):
                pixels[:, :3] = pixels[:, what:what + 1]
            elif what == "colour":
                c = pixels[:, :3]
                pixels[:, :3] = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
            elif what == "normal":
                pixels[:, :2] = (pixels[:, :2] - 0.5) * reference.get("scale", 1) + 0.5
            pixels[:, 3] = 1
            image = bpy.data.images.new(key, width, height, alpha=False, float_buffer=True)
            image.colorspace_settings.name = "Non-Color"
            image.pixels.foreach_set(pixels.astype(np.float32).ravel())
            image.pack()
        sampler = self.asset.json["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wraps = {sampler.get("wrapS", 10497), sampler.get("wrapT", 10497)}
        if len(wraps) > 1:
            raise SystemExit("textures that wrap differently in s and t are not mapped here")
        node = self.node("TexImage", image=image, interpolation="Closest" if sampler.get("magFilter") == 9728 else "Linear",
                         extension={10497: "REPEAT", 33071: "EXTEND", 33648: "MIRROR"}[wraps.pop()])
        self.set(node.inputs[0], self.node("UVMap", uv_map=self.uv(reference)).outputs[0])
        return node.outputs[0]

    def uv(self, reference):
        return "UVMap" if reference.get("texCoord", 0) == 0 else f"UVMap.{reference['texCoord']:03}"

    def channel(self, holder, name, channel, factor):
        """A factor times a channel of a texture, if there is one."""
        if name not in holder:
            return factor
        return self.math("MULTIPLY", self.image(holder[name], channel), factor)

    def normal(self):
        if "normalTexture" not in self.definition:
            return None
        reference = self.definition["normalTexture"]
        colour = self.image(reference, "normal")
        return self.node("NormalMap", {"Color": colour, "Strength": 1.0}, uv_map=self.uv(reference)).outputs[0]

    def vertex_colour(self):
        """The first vertex colour of the meshes that wear the material; None where they have none."""
        for thing in bpy.data.objects:
            if thing.type == "MESH" and any(s.material and s.material.node_tree == self.tree for s in thing.material_slots):
                for attribute in thing.data.color_attributes:
                    return self.node("VertexColor", layer_name=attribute.name)
        return None

    def lobe(self, kind, inputs, normal, **properties):
        node = self.node(kind, inputs, **properties)
        if normal is not None:
            self.set(node.inputs["Normal"], normal)
        return node.outputs[0]

    def build(self):
        d = self.definition
        pbr, extensions = d.get("pbrMetallicRoughness", {}), d.get("extensions", {})
        factor = pbr.get("baseColorFactor", [1, 1, 1, 1])
        base, alpha = list(factor[:3]), factor[3]
        if "baseColorTexture" in pbr:
            base = self.times(self.image(pbr["baseColorTexture"], "colour"), base)
            if d.get("alphaMode", "OPAQUE") != "OPAQUE":
                alpha = self.math("MULTIPLY", self.image(pbr["baseColorTexture"], 3), alpha)
        colours = self.vertex_colour()
        if colours is not None:
            base = self.times(colours.outputs[0], base)
            alpha = self.math("MULTIPLY", colours.outputs[1], alpha)
        if "KHR_materials_unlit" in extensions:
            shader = self.seen_by_camera(base, 1.0)
        else:
            shader = self.reflecting(base, pbr, extensions)
            emission = d.get("emissiveFactor", [0, 0, 0])
            if any(emission):
                if "emissiveTexture" in d:
                    emission = self.times(self.image(d["emissiveTexture"], "colour"), emission)
                strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
                shader = self.add(shader, self.seen_by_camera(emission, strength))
        mode = d.get("alphaMode", "OPAQUE")
        if mode == "MASK":
            cut = d.get("alphaCutoff", 0.5)
            alpha = self.math("SUBTRACT", 1.0, self.node("Math", {0: alpha, 1: cut}, operation="LESS_THAN").outputs[0])
        if mode != "OPAQUE":
            clear = self.node("BsdfTransparent", {0: 1.0}).outputs[0]
            shader = self.node("MixShader", {0: alpha, 1: clear, 2: shader}).outputs[0]
        if not d.get("doubleSided", False):
            # Culled for the camera alone.
            behind = self.math("MULTIPLY", self.node("NewGeometry").outputs["Backfacing"], self.camera_ray())
            clear = self.node("BsdfTransparent", {0: 1.0}).outputs[0]
            shader = self.node("MixShader", {0: behind, 1: shader, 2: clear}).outputs[0]
        self.node("OutputMaterial", {"Surface": shader})

    def reflecting(self, base, pbr, extensions):
        metallic = self.channel(pbr, "metallicRoughnessTexture", 2, pbr.get("metallicFactor", 1.0))
        roughness = self.channel(pbr, "metallicRoughnessTexture", 1, pbr.get("roughnessFactor", 1.0))
        ior = extensions.get("KHR_materials_ior", {}).get("ior", 1.5)
        gloss = extensions.get("KHR_materials_specular", {})
        weight = self.channel(gloss, "specularTexture", 3, gloss.get("specularFactor", 1.0))
        f0 = [min(((ior - 1) / (ior + 1)) ** 2 * c, 1.0) for c in gloss.get("specularColorFactor", [1, 1, 1])]
        if "specularColorTexture" in gloss:
            f0 = self.times(self.image(gloss["specularColorTexture"], "colour"), f0)
        normal = self.normal()
        rest = self.math("SUBTRACT", 1.0, metallic)
        shader = self.lobe("BsdfDiffuse", {"Color": self.times(base, rest), "Roughness": 0.0}, normal)
        weight = self.math("MULTIPLY", rest, weight)
        for share, colour in ((weight, f0), (metallic, base)):
            if isinstance(share, bpy.types.NodeSocket) or share > 0:
                shader = self.add(shader, self.node("MixShader", {0: share, 2: self.ggx(colour, roughness, normal)}).outputs[0])
        return shader

    def ggx(self, f0, roughness, normal):
        if not hasattr(bpy.types, "ShaderNodeBsdfMetallic"):
            raise SystemExit("glossy materials want Blender 4.3 or newer (pip install bpy), whose Metallic node is exact")
        inputs = {"Base Color": f0, "Edge Tint": 1.0, "Roughness": roughness}
        return self.lobe("BsdfMetallic", inputs, normal, distribution="GGX", fresnel_type="F82")

    def add(self, a, b):
        return self.node("AddShader", {0: a, 1: b}).outputs[0]

    def camera_ray(self):
        return self.node("LightPath").outputs["Is Camera Ray"]

    def seen_by_camera(self, colour, strength):
        strength = self.math("MULTIPLY", self.camera_ray(), strength)
        return self.node("Emission", {"Color": colour, "Strength": strength}).outputs[0]


def camera(place):
    eye, right, up, back, fov = place
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "VERTICAL"
    data.angle_y = fov
    data.clip_start, data.clip_end = 1e-4, 1e6
    thing = bpy.data.objects.new("camera", data)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, back, eye], 1)
    thing.matrix_world = Matrix((TURN @ matrix).tolist())
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.scene.camera = thing


def world(path):
    world = bpy.data.worlds.new("dome")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(os.path.abspath(path))
    known = [i.name for i in texture.image.colorspace_settings.bl_rna.properties["name"].enum_items]
    texture.image.colorspace_settings.name = next(n for n in ("Linear Rec.709", "Linear") if n in known)
    texture.interpolation = "Closest"
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    links.new(texture.outputs[0], background.inputs[0])
    links.new(background.outputs[0], output.inputs[0])
    # As fine as the dome: a coarser map samples a hard sun badly.
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = texture.image.size[0]


def render(options):
    scene = bpy.context.scene
    r, c = scene.render, scene.cycles
    r.engine = "CYCLES"
    r.resolution_x = r.resolution_y = options.size
    r.resolution_percentage = 100
    r.use_persistent_data = True
    r.image_settings.file_format = "OPEN_EXR"
    r.image_settings.color_depth, r.image_settings.color_mode, r.image_settings.exr_codec = "32", "RGB", "ZIP"
    transforms = scene.view_settings.bl_rna.properties["view_transform"].enum_items
    scene.view_settings.view_transform = "Raw" if "Raw" in [i.identifier for i in transforms] else "Standard"
    c.device = "CPU"
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = c.transmission_bounces = c.volume_bounces = 0
    c.transparent_max_bounces = 256
    c.sample_clamp_direct = c.sample_clamp_indirect = 0
    c.light_sampling_threshold = c.blur_glossy = 0
    c.use_adaptive_sampling = c.use_denoising = c.use_auto_tile = False
    c.pixel_filter_type = "BOX"
    c.sampling_pattern = "SOBOL" if bpy.app.version < (3, 5, 0) else "TABULATED_SOBOL"
    c.samples = options.spp
    for seed in range(options.replicates):
        c.seed = seed
        # Without it a changed seed is not noticed.
        scene.update_tag()
        bpy.ops.render.render()
        bpy.data.images["Render Result"].save_render(os.path.join(options.folder, f"{seed}.exr"), scene=scene)
    with open(os.path.join(options.folder, "tool.txt"), "w") as out:
        out.write(f"Cycles of Blender {bpy.app.version_string}")


main()
