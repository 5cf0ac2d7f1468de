//! Small files that ask for more than there is: refused in words, within four gigabytes of addresses (where an allocation
//! that fails would abort the process) and a minute of processor time.

use crate::gltf::{Builder, triangle};
use crate::support::{limited, repo};
use serde_json::json;
use std::path::Path;

const MOST_KIB: u64 = 4 << 20;

/// What the program says of these arguments; it must refuse them.
fn refused(arguments: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let mut command = limited(&format!("ulimit -v {MOST_KIB}; ulimit -t 60; exec"));
    let output = command.args(arguments).current_dir(folder.path()).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
    assert!(error.starts_with("domelight: ") && !error.contains("panicked"), "{arguments:?}: {error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "something was left behind");
    error
}

fn render_refused(scene: &Path, dome: &Path, size: &str) -> String {
    let [scene, dome] = [scene, dome].map(|path| path.to_str().unwrap());
    refused(&["render", scene, "--dome", dome, "--size", size, "--spp", "1", "--threads", "2", "-o", "out.exr"])
}

/// Every command that reads scenes refuses this one.
fn scene_says(b: &Builder, says: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.glb");
    std::fs::write(&path, b.glb()).unwrap();
    let window = repo("scenes/window.exr");
    let [scene, dome] = [&path, &window].map(|path| path.to_str().unwrap());
    for error in [
        render_refused(&path, &window, "32x24"),
        refused(&["bench", "rays", scene, "--rays", "256", "--rounds", "1"]),
        refused(&["bench", "error", scene, "--dome", dome, "--size", "32x24"]),
    ] {
        assert!(error.contains("bomb.glb") && error.contains(says), "should say '{says}': {error}");
    }
}

/// A file with 100 000 triangles.
fn many() -> Builder {
    let mut b = Builder::new();
    let position = b.vec3(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].repeat(100_000));
    b.show(json!({ "attributes": { "POSITION": position } }));
    b
}

/// Four megabytes that would be a hundred gigabytes.
#[test]
fn one_accessor_read_by_thousands() {
    let mut b = many();
    b.json["meshes"][0]["primitives"] = vec![b.json["meshes"][0]["primitives"][0].clone(); 5000].into();
    scene_says(&b, "500000000 triangles");
    let mut b = many();
    b.json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": 0 }]);
    b.json["nodes"] = (0..5000).map(|i| json!({ "mesh": 0, "weights": [f64::from(i) / 5000.0] })).collect();
    scene_says(&b, "500000000 triangles");
    let mut b = triangle();
    b.json["accessors"][0] = json!({ "componentType": 5126, "type": "VEC3", "count": 1 << 22 });
    b.json["meshes"][0]["primitives"] = vec![b.json["meshes"][0]["primitives"][0].clone(); 500].into();
    scene_says(&b, "triangles");
}

#[test]
fn one_list_of_copies_named_by_thousands() {
    let mut b = many();
    let mesh = triangle();
    let position = b.vec3(&crate::gltf::TRIANGLE);
    b.json["meshes"] = mesh.json["meshes"].clone();
    b.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(position);
    let copies = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": 0 } } });
    b.json["nodes"] = (0..5000).map(|_| json!({ "mesh": 0, "extensions": copies })).collect();
    scene_says(&b, "at most 16777216 are read");
    // Few enough to be listed, too many to be held.
    b.json["nodes"].as_array_mut().unwrap().truncate(20);
    scene_says(&b, "6000000 placements");
}

/// A picture of nothing but zeros: its file is a thousandth of it. Ten of them.
#[test]
fn pictures_that_unpack_to_gigabytes() {
    const SIDE: u32 = 8192;
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(SIDE, SIDE).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    let mut b = triangle();
    let uv = b.floats(&[0.0; 6], "VEC2", 2);
    let view = b.view(&bytes.into_inner());
    for i in 0..10 {
        b.push("images", json!({ "bufferView": view, "mimeType": "image/png" }));
        b.push("textures", json!({ "source": i }));
        b.push("materials", json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": i } } }));
    }
    let primitive = |i| json!({ "attributes": { "POSITION": 0, "TEXCOORD_0": uv }, "material": i });
    b.json["meshes"][0]["primitives"] = (0..10).map(primitive).collect();
    scene_says(&b, "their textures 7680 MiB");
    // One picture, read through ten samplers that differ.
    let wraps = [10497, 33071, 33648];
    for i in 0..10 {
        let (s, t) = (wraps[i % 3], wraps[i / 3 % 3]);
        b.push("samplers", json!({ "wrapS": s, "wrapT": t }));
        b.json["textures"][i] = json!({ "source": 0, "sampler": i });
    }
    b.json["images"].as_array_mut().unwrap().truncate(1);
    scene_says(&b, "their textures 7680 MiB");
}

#[test]
fn domes_and_films_larger_than_what_is_there() {
    let folder = tempfile::tempdir().unwrap();
    // Runs of 127 equal bytes: 16384×16384 texels in 17 megabytes.
    let mut hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16384 +X 16384\n".to_vec();
    let mut line = vec![2, 2, 64, 0];
    (0..4).for_each(|_| {
        (0..129).for_each(|_| line.extend([255, 128]));
        line.extend([129, 128]);
    });
    (0..16384).for_each(|_| hdr.extend_from_slice(&line));
    let path = folder.path().join("large.hdr");
    std::fs::write(&path, hdr).unwrap();
    let sphere = repo("scenes/sphere.glb");
    for error in [render_refused(&sphere, &path, "32x24"), refused(&["inspect", path.to_str().unwrap()])] {
        assert!(error.contains("dome of 16384x16384"), "{error}");
    }
    let error = render_refused(&sphere, &repo("scenes/window.exr"), "16384x16384");
    assert!(error.contains("film of 16384x16384"), "{error}");
}
