//! Any bytes are a scene or an error; a scene can be traced and shaded.
#![no_main]

mod file;

use domelight::accel::{self, Coherence, Hit, Mask, Ray};
use domelight::scene::{self, CameraChoice, LoadOptions, View};
use libfuzzer_sys::fuzz_target;
use std::sync::Arc;

fuzz_target!(init: file::let_panics_be_caught(), |data: &[u8]| {
    file::with_file("a.glb", data, |path| {
        let Ok(scene) = scene::load(path, &LoadOptions::default()) else { return };
        if scene.triangle_count() > 10_000 {
            return;
        }
        let scene = Arc::new(scene);
        let Ok(camera) = CameraChoice::framed().resolve(&scene, 1.0) else { return };
        let accel = accel::build("bvh", &scene, 1).expect("the loader has checked all indices");
        let view = View::new(&camera, 8, 8);
        let rays: Vec<Ray> = (0..64).map(|i| view.ray((i % 8) as f32 + 0.5, (i / 8) as f32 + 0.5)).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        accel.intersect(&rays, Mask::All, Coherence::Coherent, &mut hits);
        for (ray, hit) in rays.iter().zip(&hits).filter(|(_, hit)| hit.is_hit()) {
            let surface = scene.surface(ray, hit);
            assert!(surface.ng.is_normalized() && surface.ns.is_normalized(), "{surface:?}");
            let coverage = scene.coverage(hit);
            assert!((0.0..=1.0).contains(&coverage), "{coverage}");
        }
    });
});
