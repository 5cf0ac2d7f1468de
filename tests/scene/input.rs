//! Damaged and hostile files: each an error that names the file, the place and the way out, never a panic.
use crate::support::{Builder, glb, load_bytes, load_path, triangle};
use domelight::scene::{LoadOptions, SceneChoice, load};
use serde_json::{Value, json};

/// The error's text; it must name the file and hold `says`.
fn refused(bytes: &[u8], says: &str) {
    match load_bytes(bytes) {
        Ok(_) => panic!("accepted, should say '{says}'"),
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("test.glb") && text.contains(says), "should say '{says}': {text}");
        }
    }
}

fn edited(edit: impl FnOnce(&mut Value)) -> Vec<u8> {
    let mut b = triangle();
    edit(&mut b.json);
    b.glb()
}

#[test]
fn containers() {
    let good = triangle().glb();
    refused(&good[..7], "cut short");
    refused(&good[..good.len() - 8], "should have");
    refused(b"GLTF\x02\0\0\0", "export it again");
    refused(b"\x89PNG\r\n\x1a\n", "neither a GLB");
    refused(b"{ \"asset\": \xff }", "not UTF-8");
    refused(b"{ \"asset\": ", "JSON is wrong");
    let mut wrong = good.clone();
    wrong[4] = 1;
    refused(&wrong, "version 1");
    let mut wrong = good.clone();
    wrong[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
    refused(&wrong, "runs past the end");
    let mut wrong = good.clone();
    wrong[16] = b'X';
    refused(&wrong, "no JSON chunk");
    refused(&glb(&"[".repeat(100_000), &[]), "JSON is wrong");
    refused(&glb("{}", &[]), "only 2.0");
    refused(&glb("[]", &[]), "only 2.0");
    for length in (0..good.len()).step_by(3) {
        assert!(load_bytes(&good[..length]).is_err(), "{length}");
    }
}

#[test]
fn files_that_are_none() {
    let folder = tempfile::tempdir().expect("a folder");
    let says = |name: &str, text: &str| {
        let error = load_path(&folder.path().join(name)).expect_err("no scene").to_string();
        assert!(error.contains(name) && error.contains(text), "{error}");
    };
    std::fs::create_dir(folder.path().join("folder.glb")).expect("a folder");
    says("folder.glb", "is a directory");
    std::fs::write(folder.path().join("empty.glb"), b"").expect("a file");
    says("empty.glb", "is empty");
    says("missing.glb", "o such file");
    #[cfg(unix)]
    {
        let status = std::process::Command::new("mkfifo").arg(folder.path().join("pipe.glb")).status();
        if status.is_ok_and(|s| s.success()) {
            says("pipe.glb", "not a regular file");
        }
    }
}

#[test]
fn indices_and_ranges() {
    refused(&edited(|j| j["nodes"][0]["mesh"] = json!(7)), "meshes[7]");
    refused(&edited(|j| j["nodes"][0]["children"] = json!([9])), "nodes[9]");
    refused(&edited(|j| j["nodes"][0]["children"] = json!([0])), "own ancestor");
    refused(
        &edited(|j| j["nodes"] = json!([{ "children": [1] }, { "children": [2] }, { "children": [1] }])),
        "one parent",
    );
    refused(&edited(|j| j["nodes"] = json!([{ "mesh": 0 }, { "children": [2] }, { "children": [1] }])), "own ancestor");
    refused(&edited(|j| j["nodes"][0]["camera"] = json!(0)), "cameras[0]");
    refused(&edited(|j| j["nodes"][0]["skin"] = json!(0)), "skins[0]");
    refused(&edited(|j| j["nodes"][0]["scale"] = json!([1e38, 1e38, 3e39])), "overflows");
    refused(&edited(|j| j["scenes"] = json!([{ "nodes": [4] }])), "nodes[4]");
    refused(&edited(|j| j["scene"] = json!(3)), "no scene 3");
    refused(&edited(|j| j["accessors"][0]["count"] = json!(4)), "needs 4 elements");
    refused(&edited(|j| j["accessors"][0]["count"] = json!(u64::MAX)), "needs");
    refused(&edited(|j| j["accessors"][0]["count"] = json!(-1)), "accessors[0]");
    refused(&edited(|j| j["accessors"][0]["byteOffset"] = json!(u64::MAX)), "damaged");
    refused(&edited(|j| j["accessors"][0]["componentType"] = json!(77)), "componentType");
    refused(&edited(|j| j["accessors"][0]["type"] = json!("VEC2")), "components");
    refused(&edited(|j| j["bufferViews"][0]["byteLength"] = json!(u64::MAX)), "spans");
    refused(&edited(|j| j["bufferViews"][0]["byteStride"] = json!(4)), "every 4 bytes");
    refused(&edited(|j| j["bufferViews"][0]["buffer"] = json!(4)), "buffers[4]");
    refused(&edited(|j| j["meshes"][0]["primitives"][0]["mode"] = json!(9)), "mode");
    refused(&edited(|j| j["meshes"][0]["primitives"][0]["material"] = json!(9)), "materials[9]");
    refused(&edited(|j| j["buffers"] = json!([{ "byteLength": 4000 }])), "should have 4000");
    let virtual_ = json!({ "componentType": 5126, "type": "VEC3", "count": 4_000_000_000u64 });
    refused(&edited(|j| j["accessors"][0] = virtual_), "without any data");
    let mut b = triangle();
    let indices = b.indices(&[0, 1, 3]);
    b.json["meshes"][0]["primitives"][0]["indices"] = json!(indices);
    refused(&b.glb(), "vertex 3");
}

#[test]
fn extensions() {
    refused(&edited(|j| j["extensionsRequired"] = json!(["KHR_draco_mesh_compression"])), "untick Compression");
    refused(&edited(|j| j["extensionsRequired"] = json!(["EXT_meshopt_compression"])), "gltf-transform");
    refused(&edited(|j| j["extensionsRequired"] = json!(["KHR_texture_basisu"])), "PNG, JPEG or WebP");
    refused(&edited(|j| j["extensionsRequired"] = json!(["ACME_new"])), "ACME_new");
    let copies = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": 9 } } });
    refused(&edited(|j| j["nodes"][0]["extensions"] = copies), "accessors[9]");
}

#[test]
fn references_out_of_the_folder() {
    for uri in
        ["../a.bin", "%2e%2e/a.bin", "/etc/hostname", "http://example.org/a.bin", "file:///etc/hostname", "C:\\a"]
    {
        refused(&edited(|j| j["buffers"] = json!([{ "byteLength": 36, "uri": uri }])), "beside the asset");
    }
    refused(&edited(|j| j["buffers"] = json!([{ "byteLength": 36, "uri": "gone.bin" }])), "gone.bin");
    let broken = "data:application/octet-stream;base64,@@@@";
    refused(&edited(|j| j["buffers"] = json!([{ "byteLength": 3, "uri": broken }])), "base64");
    refused(&edited(|j| j["buffers"] = json!([{ "byteLength": 36, "uri": "data:;base64,AAAA" }])), "cut short");
}

/// A textured triangle whose image is these bytes.
fn textured(image: &[u8]) -> Builder {
    let mut b = triangle();
    let uv = b.floats(&[0.0, 0.0, 1.0, 0.0, 0.0, 1.0], "VEC2", 2);
    let view = b.view(image);
    b.push("images", json!({ "bufferView": view, "mimeType": "image/png" }));
    b.push("textures", json!({ "source": 0 }));
    b.push("materials", json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }));
    b.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    b.json["meshes"][0]["primitives"][0]["material"] = json!(0);
    b
}

/// A grey picture of this size as PNG.
fn png(width: u32, height: u32) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let image = image::GrayImage::from_fn(width, height, |x, y| image::Luma([(x * 7 + y * 3) as u8]));
    image.write_to(&mut out, image::ImageFormat::Png).expect("a PNG");
    out.into_inner()
}

#[test]
fn images() {
    assert!(textured(&png(4, 4)).load().expect("a scene").needs.textures);
    let good = png(64, 64);
    refused(&textured(&good[..good.len() / 2]).glb(), "images[0]");
    refused(&textured(b"").glb(), "images[0]");
    refused(&textured(b"GIF89a\x01\0\x01\0").glb(), "neither PNG");
    let mut large = good.clone();
    // Width and height of the header chunk; its checksum is wrong then, which may be what is said.
    large[16..20].copy_from_slice(&65535u32.to_be_bytes());
    large[20..24].copy_from_slice(&65535u32.to_be_bytes());
    refused(&textured(&large).glb(), "images[0]");
    // A WebP header without a checksum: 16383 × 16383 pixels in 30 bytes.
    let mut webp = b"RIFF\x1a\0\0\0WEBPVP8L\x0d\0\0\0\x2f".to_vec();
    webp.extend([0xff, 0xff, 0xff, 0x0f, 0, 0, 0, 0, 0, 0, 0, 0]);
    refused(&textured(&webp).glb(), "images[0]");
    let mut b = textured(&good);
    b.json["textures"][0]["source"] = json!(5);
    refused(&b.glb(), "images[5]");
    let mut b = textured(&good);
    b.json["textures"][0]["sampler"] = json!(5);
    refused(&b.glb(), "samplers[5]");
    let mut b = textured(&good);
    b.json["images"][0] = json!({ "uri": "../secret.png" });
    refused(&b.glb(), "leaves the asset's folder");
    let mut b = textured(&good);
    b.json["textures"][0] = json!({ "extensions": { "KHR_texture_basisu": { "source": 0 } } });
    refused(&b.glb(), "KHR_texture_basisu");
}

#[test]
fn scenes_by_name_and_index() {
    let mut b = triangle();
    b.json["scenes"] = json!([{ "name": "first", "nodes": [0] }, { "name": "second" }]);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("two.glb");
    std::fs::write(&path, b.glb()).expect("a file");
    let triangles = |scene| load(&path, &LoadOptions { scene: Some(scene) }).map(|s| s.triangle_count());
    assert_eq!(triangles(SceneChoice::Name("first".into())).expect("a scene"), 1);
    assert_eq!(triangles(SceneChoice::Name("1".into())).expect("a scene"), 0);
    assert_eq!(triangles(SceneChoice::Index(1)).expect("a scene"), 0);
    let error = triangles(SceneChoice::Name("third".into())).expect_err("no scene").to_string();
    assert!(error.contains("'third'") && error.contains("0 (first), 1 (second)"), "{error}");
}

#[test]
fn deep_and_wide_hierarchies() {
    let mut b = triangle();
    let depth = 100_000;
    let chain = (0..depth).map(|i| match i + 1 < depth {
        true => json!({ "children": [i + 1] }),
        false => json!({ "mesh": 0 }),
    });
    b.json["nodes"] = chain.collect();
    assert_eq!(b.load().expect("a scene").triangle_count(), 1);
    b.json["nodes"] = (0..depth).map(|i| json!({ "mesh": 0, "translation": [i, 0, 0] })).collect();
    let scene = b.load().expect("a scene");
    assert_eq!((scene.triangle_count(), scene.meshes.len()), (depth as u64, 1));
}

/// Bytes flipped and files cut, everywhere: a scene or an error, nothing else.
#[test]
fn mutations() {
    let mut b = textured(&png(16, 16));
    let normals = b.vec3(&[[0.0, 0.0, 1.0]; 3]);
    b.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(normals);
    b.json["materials"][0]["normalTexture"] = json!({ "index": 0 });
    let indices = b.indices(&[0, 1, 2]);
    b.json["meshes"][0]["primitives"][0]["indices"] = json!(indices);
    let good = b.glb();
    assert!(load_bytes(&good).is_ok());
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as usize
    };
    let mut accepted = 0;
    for _ in 0..1500 {
        let mut bytes = good.clone();
        for _ in 0..1 + random() % 3 {
            let at = random() % bytes.len();
            // Digits become digits: numbers change while the JSON stays whole.
            bytes[at] = if bytes[at].is_ascii_digit() { b'0' + (random() % 10) as u8 } else { random() as u8 };
        }
        if random() % 8 == 0 {
            bytes.truncate(random() % bytes.len());
        }
        if let Ok(scene) = load_bytes(&bytes) {
            accepted += 1;
            let held: usize = scene.meshes.iter().map(|m| m.positions.len() * 12 + m.indices.len() * 12).sum();
            let texels: usize = scene.textures.iter().map(|t| t.texels.len() * 4).sum();
            assert!(held + texels < 1 << 26, "{held} + {texels} bytes");
        }
    }
    assert!(accepted > 20, "{accepted}");
}
