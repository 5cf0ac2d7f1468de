"""Makes the reference images of this folder again: `python make.py`, or some of them: `python make.py sphere- -povray`.

Wants numpy and OpenEXR (PyPI), for Cycles either bpy (PyPI) or `--blender blender`, for POV-Ray the program povray.
"""

import argparse
import hashlib
import os
import shlex
import subprocess
import sys
import tempfile

import numpy as np
import OpenEXR

HERE = os.path.dirname(os.path.abspath(__file__))
SCENES = os.path.dirname(HERE)
REPLICATES = 16

# Scenes, domes, referee, samples a pixel and replicate. POV-Ray does not seek out what is bright: soft domes are its.
JOBS = [
    (["sphere", "terrain", "nodes", "materials"], ["overcast_sun", "window", "studio"], "cycles", 64),
    (["colonnade"], ["overcast_sun", "studio"], "cycles", 64),
    # Windows through slats: the noisiest.
    (["colonnade"], ["window"], "cycles", 192),
    (["sphere", "colonnade", "terrain"], ["overcast"], "povray", 32),
    (["sphere"], ["studio"], "povray", 128),
]

# Assets of others, which are not kept here: file, camera. `--assets FOLDER` says where they are.
ASSETS = [
    ("Suzanne/Suzanne.gltf", ["--eye=1,0.6,4.5", "--look-at=0,0,0", "--fov=38"]),
    ("Avocado/Avocado.gltf", ["--eye=0.05,0.06,0.16", "--look-at=0,0.031,0", "--fov=28"]),
    ("SpecularTest.glb", ["--eye=-0.19,0,2", "--look-at=-0.19,0,0", "--fov=36"]),
    ("VertexColorTest.glb", ["--eye=0.3,0.2,4", "--look-at=0,0,0", "--fov=36"]),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help="make those whose names hold one of these (SCENE-DOME-REFEREE)")
    parser.add_argument("--out", default=HERE, help="where the images go")
    parser.add_argument("--blender", help="run cycles.py in this program instead of Python's own bpy")
    parser.add_argument("--assets", help="make those of the assets in this folder instead, into target/references")
    options = parser.parse_args()
    if options.assets:
        out = os.path.join(os.path.dirname(SCENES), "target", "references")
        os.makedirs(out, exist_ok=True)
        for (file, camera), dome in ((a, d) for a in ASSETS for d in JOBS[0][1]):
            name = os.path.splitext(os.path.basename(file))[0]
            image = os.path.join(out, f"{name}-{dome}-cycles.exr")
            scene = os.path.join(os.path.abspath(options.assets), file)
            make(scene, f"{dome}.exr", "cycles", ["--spp", "64", *camera], image, options.blender)
            print(image, flush=True)
        return
    for scenes, domes, referee, spp in JOBS:
        for scene, dome in ((s, d) for s in scenes for d in domes):
            name = f"{scene}-{dome}-{referee}"
            if options.parts and not any(part in name for part in options.parts):
                continue
            image = os.path.join(options.out, name + ".exr")
            extra = ["--spp", str(spp)]
            make(f"{scene}.glb", f"{dome}.exr", referee, extra, image, options.blender)
            print(image, flush=True)


def make(scene, dome, referee, extra, image, blender=None):
    """One reference; `scene` and `dome` are paths relative to the folder of scenes."""
    with tempfile.TemporaryDirectory() as folder:
        script = os.path.join(HERE, f"{referee}.py")
        arguments = [scene, dome, folder, "--replicates", str(REPLICATES), *extra]
        run = [blender, "-b", "-P", script, "--"] if blender and referee == "cycles" else [sys.executable, script]
        done = subprocess.run([*run, *arguments], cwd=SCENES, capture_output=True, text=True)
        if done.returncode or not os.path.exists(os.path.join(folder, "tool.txt")):
            raise SystemExit(f"{shlex.join([*run, *arguments])} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
        pictures = [read(os.path.join(folder, f"{i}.exr")) for i in range(REPLICATES)]
        tool = open(os.path.join(folder, "tool.txt")).read()
    command = [f"{referee}.py", scene, dome, "FOLDER", *arguments[3:]]
    pictures = np.array(pictures, np.float64)
    facts = {
        "tool": tool,
        "command": shlex.join(command),
        "spp": extra[extra.index("--spp") + 1] + " a replicate",
        "seeds": f"0..{REPLICATES - 1}",
        "replicates": str(REPLICATES),
        "sceneSha256": sha256(scene),
        "domeSha256": sha256(dome),
    }
    write(image, pictures.mean(0), pictures.var(0, ddof=1) / REPLICATES, facts)


def sha256(path):
    return hashlib.sha256(open(os.path.join(SCENES, path), "rb").read()).hexdigest()


def read(path):
    channels = OpenEXR.File(path, separate_channels=True).channels()
    return np.stack([channels[c].pixels for c in "RGB"], -1)


def write(path, mean, variance, facts):
    """Half floats for the picture, whose rounding counts as noise, and bfloat16 in floats for the variance."""
    half = mean.astype(np.float16)
    variance = variance + np.spacing(np.abs(half)).astype(np.float64) ** 2 / 12
    bits = (variance.astype(np.float32).view(np.uint32) + 0x8000) & 0xFFFF0000
    variance = bits.astype(np.uint32).view(np.float32)
    channels = {c: np.ascontiguousarray(half[..., i]) for i, c in enumerate("RGB")}
    channels |= {"variance." + c: np.ascontiguousarray(variance[..., i]) for i, c in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **facts}
    OpenEXR.File(header, channels).write(path)


if __name__ == "__main__":
    main()
