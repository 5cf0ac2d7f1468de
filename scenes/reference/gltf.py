"""What the reference scripts read of a glTF file, without any library but numpy."""

import base64
import json
import os
import struct
from urllib.parse import unquote

import numpy as np

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Asset:
    """JSON and buffers of a .glb or .gltf."""

    def __init__(self, path):
        self.folder = os.path.dirname(os.path.abspath(path))
        data = open(path, "rb").read()
        binary = None
        if data[:4] == b"glTF":
            length = struct.unpack_from("<I", data, 12)[0]
            text, rest = data[20:20 + length], data[20 + length:]
            binary = rest[8:8 + struct.unpack_from("<I", rest)[0]] if rest else None
        else:
            text = data
        self.json = json.loads(text)
        self.buffers = [self.bytes(b["uri"]) if "uri" in b else binary for b in self.json.get("buffers", [])]

    def bytes(self, uri):
        if uri.startswith("data:"):
            return base64.b64decode(uri.split(",", 1)[1])
        return open(os.path.join(self.folder, unquote(uri)), "rb").read()

    def list(self, name):
        return self.json.get(name, [])

    def view(self, index):
        view = self.json["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start:start + view["byteLength"]]

    def accessor(self, index):
        """An array of count × width values; integers stay integers."""
        a = self.json["accessors"][index]
        if "sparse" in a or "bufferView" not in a or a.get("normalized"):
            raise SystemExit("sparse, empty and normalized accessors are not read here")
        kind, width = np.dtype(COMPONENTS[a["componentType"]]), WIDTHS[a["type"]]
        stride = self.json["bufferViews"][a["bufferView"]].get("byteStride", kind.itemsize * width)
        data = self.view(a["bufferView"])[a.get("byteOffset", 0):]
        return np.ndarray((a["count"], width), kind, data, strides=(stride, kind.itemsize)).copy()

    def image(self, index):
        """The encoded bytes of an image."""
        image = self.json["images"][index]
        return self.view(image["bufferView"]) if "bufferView" in image else self.bytes(image["uri"])

    def roots(self):
        scenes = self.list("scenes")
        return scenes[self.json.get("scene", 0)]["nodes"] if scenes else range(len(self.list("nodes")))

    def nodes(self):
        """(node, matrix to the world) for all that the scene shows."""
        def visit(index, parent):
            node = self.json["nodes"][index]
            world = parent @ local(node)
            yield node, world
            for child in node.get("children", []):
                yield from visit(child, world)
        for root in self.roots():
            yield from visit(root, np.eye(4))

    def camera(self):
        """The first camera: (eye, right, up, back, vertical field of view in radians); None without one."""
        for node, world in self.nodes():
            if "camera" in node:
                lens = self.json["cameras"][node["camera"]]["perspective"]
                axes = [world[:3, k] / np.linalg.norm(world[:3, k]) for k in range(3)]
                return world[:3, 3], *axes, lens["yfov"]
        return None

    def save_glb(self, path):
        """Everything in one binary file."""
        binary = b""
        starts = []
        for data in self.buffers:
            starts.append(len(binary))
            binary += data + b"\0" * (-len(data) % 4)
        root = json.loads(json.dumps(self.json))
        for view in root.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
            view["buffer"] = 0
        root["buffers"] = [{"byteLength": len(binary)}]
        text = json.dumps(root).encode()
        text += b" " * (-len(text) % 4)
        with open(path, "wb") as out:
            out.write(b"glTF" + struct.pack("<II", 2, 28 + len(text) + len(binary)))
            out.write(struct.pack("<I", len(text)) + b"JSON" + text)
            out.write(struct.pack("<I", len(binary)) + b"BIN\0" + binary)


def local(node):
    """A node's own matrix."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    m = np.eye(4)
    m[:3, :3] = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]) * node.get("scale", (1, 1, 1))
    m[:3, 3] = node.get("translation", (0, 0, 0))
    return m


def look_at(eye, target, fov):
    """A camera as `Asset.camera` gives it."""
    eye, back = np.array(eye, float), np.array(eye, float) - target
    back /= np.linalg.norm(back)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    return eye, right, np.cross(back, right), back, np.radians(fov)


def arguments(parser, argv):
    """The options that all referees share; `camera` is resolved."""
    triple = lambda text: [float(v) for v in text.split(",")]
    parser.add_argument("scene", help=".glb or .gltf")
    parser.add_argument("dome", help="lat-long EXR or HDR")
    parser.add_argument("folder", help="where the replicates go: 0.exr, 1.exr, …")
    parser.add_argument("--size", type=int, default=128, help="width and height, pixels")
    parser.add_argument("--replicates", type=int, default=16)
    parser.add_argument("--eye", type=triple, help="X,Y,Z; without it the asset's first camera")
    parser.add_argument("--look-at", type=triple, default=[0.0, 0.0, 0.0])
    parser.add_argument("--fov", type=float, default=40.0, help="vertical, degrees")
    options = parser.parse_args(argv)
    options.asset = Asset(options.scene)
    options.camera = look_at(options.eye, options.look_at, options.fov) if options.eye else options.asset.camera()
    if options.camera is None:
        raise SystemExit(f"{options.scene} has no camera: give --eye, --look-at and --fov")
    os.makedirs(options.folder, exist_ok=True)
    return options
