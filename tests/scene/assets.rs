//! The shared asset set: every file loads with the triangles its manifest counts, or says what is in its way.
use crate::support::load_path;
use domelight::scene::{AlphaMode, Scene};
use std::path::PathBuf;

/// File and triangles of the default scene; a text for those that must be refused.
const ASSETS: &[(&str, std::result::Result<u64, &str>)] = &[
    ("BoxVertexColors.glb", Ok(12)),
    ("AlphaBlendModeTest.glb", Ok(61)),
    ("MultiUVTest.glb", Ok(12)),
    ("NormalTangentTest.glb", Ok(7774)),
    ("OrientationTest.glb", Ok(524)),
    ("NegativeScaleTest.glb", Ok(7724)),
    ("TextureSettingsTest.glb", Ok(72)),
    ("TextureTransformMultiTest.glb", Ok(3956)),
    ("VertexColorTest.glb", Ok(36)),
    ("MorphPrimitivesTest.glb", Ok(32)),
    ("Fox.glb", Ok(576)),
    ("ClearCoatTest.glb", Ok(37116)),
    ("SpecularTest.glb", Ok(44828)),
    ("EmissiveStrengthTest.glb", Ok(90)),
    ("GlassVaseFlowers.glb", Ok(14036)),
    ("MetalRoughSpheresNoTextures.glb", Ok(1_040_409)),
    // 12 triangles; the manifest does not count the 125 copies.
    ("SimpleInstancing.glb", Ok(12 * 125)),
    ("TransmissionTest.glb", Ok(128_775)),
    ("GlamVelvetSofa.glb", Ok(4196)),
    ("Avocado/Avocado.gltf", Ok(682)),
    ("SheenCloth/SheenCloth.gltf", Ok(115_200)),
    ("SimpleSparseAccessor/SimpleSparseAccessor.gltf", Ok(12)),
    ("Suzanne/Suzanne.gltf", Ok(3936)),
    ("TwoSidedPlane/TwoSidedPlane.gltf", Ok(2)),
    ("MeshPrimitiveModes-Embedded/MeshPrimitiveModes.gltf", Ok(16)),
    ("Cameras-Embedded/Cameras.gltf", Ok(2)),
    ("Avocado-Quantized/Avocado.gltf", Ok(682)),
    ("Box-Draco/Box.gltf", Err("KHR_draco_mesh_compression")),
    ("BoxMeshopt.glb", Err("EXT_meshopt_compression")),
];

fn asset(name: &str) -> Option<PathBuf> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/gltf").join(name);
    path.exists().then_some(path)
}

fn scene(name: &str) -> Option<Scene> {
    Some(load_path(&asset(name)?).unwrap_or_else(|e| panic!("{name}: {e}")))
}

#[test]
fn every_asset_loads_or_says_why_not() {
    for (name, expected) in ASSETS {
        let Some(path) = asset(name) else {
            eprintln!("skipped: {name} is not here");
            continue;
        };
        match (load_path(&path), expected) {
            (Ok(scene), Ok(triangles)) => {
                assert_eq!(scene.triangle_count(), *triangles, "{name}");
                assert!(scene.bounds[1].cmpge(scene.bounds[0]).all() && scene.bounds[0].is_finite(), "{name}");
                eprintln!("{name}: {:?} {} meshes {:?}", scene.needs, scene.meshes.len(), scene.warnings);
            }
            (Err(error), Err(says)) => {
                let error = error.to_string();
                assert!(error.contains(says) && error.contains("gltf-transform"), "{name}: {error}");
            }
            (Ok(_), Err(_)) => panic!("{name} should have been refused"),
            (Err(error), Ok(_)) => panic!("{error}"),
        }
    }
}

#[test]
fn quantised_and_plain_avocado_are_the_same_fruit() {
    let (Some(a), Some(b)) = (scene("Avocado/Avocado.gltf"), scene("Avocado-Quantized/Avocado.gltf")) else { return };
    for i in 0..2 {
        assert!((a.bounds[i] - b.bounds[i]).length() < 1e-4, "{:?} {:?}", a.bounds, b.bounds);
    }
}

#[test]
fn materials_are_read() {
    if let Some(s) = scene("AlphaBlendModeTest.glb") {
        assert!(s.needs.alpha && s.needs.textures && s.needs.tangents);
        assert!(s.materials.iter().any(|m| matches!(m.alpha, AlphaMode::Mask(c) if c == 0.25)));
        assert!(s.materials.iter().any(|m| m.alpha == AlphaMode::Blend));
    }
    if let Some(s) = scene("ClearCoatTest.glb") {
        let line = s.warnings.iter().find(|w| w.contains("KHR_materials_clearcoat")).expect("a warning");
        assert!(line.contains("is ignored (") && line.contains("materials)"), "{line}");
    }
    if let Some(s) = scene("EmissiveStrengthTest.glb") {
        assert!(s.materials.iter().any(|m| m.emission.max_element() > 4.0));
    }
    if let Some(s) = scene("MultiUVTest.glb") {
        assert_eq!(s.needs.uv_sets, 2);
    }
    if let Some(s) = scene("MeshPrimitiveModes-Embedded/MeshPrimitiveModes.gltf") {
        assert!(s.warnings.iter().any(|w| w == "points are skipped (1 primitive)"), "{:?}", s.warnings);
        assert!(s.warnings.iter().any(|w| w == "lines are skipped (3 primitives)"), "{:?}", s.warnings);
    }
    if let Some(s) = scene("Cameras-Embedded/Cameras.gltf") {
        assert_eq!(s.cameras.len(), 2);
    }
}

/// Bytes of a rich scene changed here and there: a scene or an error, within bounds.
#[test]
fn mutated_generated_scenes_are_scenes_or_errors() {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("scenes/materials.glb");
    let good = std::fs::read(path).expect("the repository's own scene");
    let text = u32::from_le_bytes([good[12], good[13], good[14], good[15]]) as usize;
    let mut state = 0x2545_f491_4f6c_dd1du64;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 16) as usize
    };
    let mut accepted = 0;
    for round in 0..300 {
        let mut bytes = good.clone();
        // Most of the damage goes where the structure is.
        let reach = if round % 3 == 0 { bytes.len() } else { 20 + text };
        for _ in 0..1 + random() % 4 {
            let at = random() % reach;
            bytes[at] =
                if bytes[at].is_ascii_digit() { b'0' + (random() % 10) as u8 } else { bytes[at] ^ 1 << (random() % 8) };
        }
        if let Ok(scene) = crate::support::load_bytes(&bytes) {
            accepted += 1;
            let held: usize = scene.meshes.iter().map(|m| m.positions.len() * 12 + m.indices.len() * 12).sum();
            let texels: usize = scene.textures.iter().map(|t| t.texels.len() * 4).sum();
            assert!(held + texels < 1 << 27, "{held} + {texels} bytes");
        }
    }
    assert!(accepted > 20, "{accepted}");
}
