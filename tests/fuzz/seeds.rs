//! Writes the seed corpus: `seeds FOLDER`. Small files of every kind that is read, made here.

#[path = "../scene/support.rs"]
#[allow(dead_code, reason = "tests use more of it")]
mod scene;

use domelight::output::{self, Frame, for_path};
use exr::prelude::*;
use scene::Builder;
use serde_json::json;
use std::fs;
use std::path::Path;

fn main() {
    let folder = std::env::args_os().nth(1).expect("usage: seeds FOLDER");
    let folder = Path::new(&folder);
    for kind in ["gltf", "exr", "hdr", "params"] {
        fs::create_dir_all(folder.join(kind)).expect("the folder can be made");
    }
    gltf(&folder.join("gltf"));
    exr_images(&folder.join("exr"));
    hdr(&folder.join("hdr"));
    params(&folder.join("params"));
}

fn put(path: &Path, bytes: &[u8]) {
    fs::write(path, bytes).expect("the file can be written");
}

/// A triangle with everything a vertex may have.
fn rich() -> Builder {
    let mut b = scene::triangle();
    let normal = b.vec3(&[[0.0, 0.0, 1.0]; 3]);
    let uv = b.floats(&[0.0, 0.0, 1.0, 0.0, 0.0, 1.0], "VEC2", 2);
    let color = b.floats(&[0.5; 12], "VEC4", 4);
    let indices = b.indices(&[0, 1, 2]);
    let mut png = std::io::Cursor::new(Vec::new());
    let image = image::RgbaImage::from_fn(4, 4, |x, y| image::Rgba([x as u8 * 60, y as u8 * 60, 9, 128]));
    image.write_to(&mut png, image::ImageFormat::Png).expect("writing to memory");
    let view = b.view(&png.into_inner());
    b.push("images", json!({ "bufferView": view, "mimeType": "image/png" }));
    b.push("samplers", json!({ "wrapS": 33071, "wrapT": 33648, "magFilter": 9728 }));
    b.push("textures", json!({ "source": 0, "sampler": 0 }));
    let texture = json!({ "index": 0, "extensions": { "KHR_texture_transform": { "scale": [2, 3], "rotation": 1 } } });
    b.push(
        "materials",
        json!({
            "alphaMode": "BLEND", "emissiveFactor": [1, 1, 0], "normalTexture": { "index": 0, "scale": 0.5 },
            "pbrMetallicRoughness": { "baseColorTexture": texture, "metallicRoughnessTexture": { "index": 0 } },
            "extensions": { "KHR_materials_ior": { "ior": 1.3 }, "KHR_materials_specular": { "specularFactor": 0.5 } }
        }),
    );
    let primitive = &mut b.json["meshes"][0]["primitives"][0];
    primitive["attributes"]["NORMAL"] = json!(normal);
    primitive["attributes"]["TEXCOORD_0"] = json!(uv);
    primitive["attributes"]["COLOR_0"] = json!(color);
    primitive["indices"] = json!(indices);
    primitive["material"] = json!(0);
    b
}

fn gltf(folder: &Path) {
    let mut all = vec![("triangle", scene::triangle()), ("rich", rich())];
    let mut b = rich();
    let delta = b.vec3(&[[0.0, 0.0, 1.0]; 3]);
    b.json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": delta }]);
    b.json["meshes"][0]["weights"] = json!([0.5]);
    b.json["nodes"] = json!([{ "mesh": 0, "scale": [1, -1, 2], "children": [1] }, { "camera": 0 }]);
    b.json["cameras"] = json!([{ "type": "perspective", "perspective": { "yfov": 0.7, "znear": 0.1 } }]);
    b.json["scenes"] = json!([{ "nodes": [0], "name": "a" }, { "nodes": [] }]);
    b.json["scene"] = json!(0);
    all.push(("morph", b));
    let mut b = scene::triangle();
    let where_ = b.view(&[1, 2]);
    let values = b.view(&[0; 24]);
    b.json["accessors"][0]["sparse"] = json!({
        "count": 2, "indices": { "bufferView": where_, "componentType": 5121 }, "values": { "bufferView": values }
    });
    let copies = b.vec3(&[[0.0; 3], [1.0, 2.0, 3.0]]);
    b.json["nodes"][0]["extensions"] = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": copies } } });
    all.push(("sparse copies", b));
    let mut b = scene::triangle();
    let joints = b.view(&[0; 12]);
    let accessor = json!({ "bufferView": joints, "componentType": 5121, "count": 3, "type": "VEC4" });
    let joints = b.push("accessors", accessor);
    let weights = b.floats(&[0.25; 12], "VEC4", 4);
    let attributes = &mut b.json["meshes"][0]["primitives"][0]["attributes"];
    attributes["JOINTS_0"] = json!(joints);
    attributes["WEIGHTS_0"] = json!(weights);
    b.push("skins", json!({ "joints": [1] }));
    b.json["nodes"] = json!([{ "mesh": 0, "skin": 0 }, { "rotation": [0, 0, 0, 1] }]);
    all.push(("skin", b));
    for mode in [5, 6, 0] {
        let mut b = rich();
        b.json["meshes"][0]["primitives"][0]["mode"] = json!(mode);
        all.push((["points", "", "", "", "", "strip", "fan"][mode], b));
    }
    for (name, builder) in &all {
        put(&folder.join(name), &builder.glb());
    }
    // JSON alone, its data beside it.
    let mut b = scene::triangle();
    b.json["buffers"] = json!([{ "byteLength": 36, "uri": format!("data:;base64,{}", "A".repeat(48)) }]);
    put(&folder.join("text"), b.json.to_string().as_bytes());
}

fn exr_images(folder: &Path) {
    let size = (8, 4);
    let ramp: Vec<f32> = (0..32).map(|i| i as f32).collect();
    let half: Vec<f16> = ramp.iter().map(|v| f16::from_f32(*v)).collect();
    let all = [Compression::Uncompressed, Compression::RLE, Compression::ZIP1, Compression::ZIP16, Compression::PIZ]
        .into_iter()
        .chain([Compression::PXR24, Compression::B44, Compression::DWAA(None)]);
    for (i, compression) in all.enumerate() {
        for (blocks, kind) in [(Blocks::ScanLines, "lines"), (Blocks::Tiles(Vec2(4, 4)), "tiles")] {
            let samples = |c: usize| match (i + c) % 2 {
                0 => FlatSamples::F32(ramp.clone()),
                _ => FlatSamples::F16(half.clone()),
            };
            let channels = ["R", "G", "B"].iter().enumerate().map(|(c, name)| AnyChannel::new(*name, samples(c)));
            let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
            let layer = Layer::new(size, LayerAttributes::default(), encoding, AnyChannels::sort(channels.collect()));
            let image = Image::from_layer(layer);
            image.write().to_file(folder.join(format!("{i} {kind}"))).expect("the file can be written");
        }
    }
}

fn hdr(folder: &Path) {
    let header = |first: &str, size: &str| format!("{first}\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n\n{size}\n").into_bytes();
    let mut flat = header("#?RADIANCE", "-Y 2 +X 4");
    flat.extend([128, 64, 32, 129].repeat(8));
    put(&folder.join("flat"), &flat);
    // Run-length encoded by channel: 8 columns, a run of 5 and 3 plain bytes each.
    let mut runs = header("#?RGBE", "-Y 2 +X 8");
    for _ in 0..2 {
        runs.extend([2, 2, 0, 8]);
        (0..4).for_each(|_| runs.extend([133, 100, 3, 1, 2, 3]));
    }
    put(&folder.join("runs"), &runs);
    let mut old = header("#?RADIANCE", "-Y 1 +X 6");
    old.extend([128, 64, 32, 129, 1, 1, 1, 5]);
    put(&folder.join("old runs"), &old);
}

fn params(folder: &Path) {
    let texts = ["tessellated:triangles=2048,groups=auto,cache=off,cache-mb=64", "latlong:mis", "embree:robust=on",
        "bvh:isa=portable", "png:tonemap=aces,exposure=-1.5", "exr", "cosine", "direct", "ao", "brute"];
    for (i, text) in texts.iter().enumerate() {
        put(&folder.join(i.to_string()), text.as_bytes());
    }
    // Metadata and layers as the program writes them.
    let layer = output::Layer { name: String::new(), channels: vec!["R", "G", "B", "A"], pixels: vec![0.5; 16] };
    let frame = Frame { width: 2, height: 2, offset: [0; 2], full: [2; 2], layers: vec![layer], metadata: vec![] };
    let path = folder.with_file_name("exr").join("picture.exr");
    for_path(&path, "").and_then(|o| o.write(&path, &frame)).expect("the file can be written");
}

