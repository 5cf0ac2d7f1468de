//! The variance that a render states of its pixels is the one that pictures of many seeds have.

use crate::support::render::{BESIDE, Shot, cuboid, pixels, scene, square, white};
use crate::support::samplers::{dome, sampler};
use domelight::accel;
use domelight::scene::CameraChoice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

const SIDE: u32 = 12;
const SEEDS: u32 = 64;

/// Samples of a stratified set are not independent: their spread would claim several times the variance.
#[test]
fn stated_variances_are_those_over_seeds() {
    let block = cuboid(Vec3::new(-0.5, 0.0, -0.5), Vec3::new(0.3, 0.9, 0.2));
    let scene = scene(vec![(square(Vec3::ZERO, Vec3::Y, 40.0), white()), (block, white())]);
    let accel = accel::build("bvh", &scene, 2).unwrap();
    let eye = Vec3::new(0.6, 2.0, 3.2);
    let camera =
        CameraChoice::LookAt { eye, target: Vec3::new(0.0, 0.3, 0.0), fov: 40.0 }.resolve(&scene, 1.0).unwrap();
    let dome = dome(64, 32, |x, y| if (x, y) == (20, 7) { [90.0, 80.0, 60.0] } else { [0.5, 0.6, 0.8] });
    // Replicates of 2, of 4 and of 12 camera samples; the last are longer than the learning stages.
    for (spec, spp, rays) in
        [("tessellated:cache-block=4", 32, 4), ("latlong", 64, 1), ("tessellated:triangles=256", 192, 1)]
    {
        let shot = Shot {
            scene: &scene,
            dome: &dome,
            camera: &camera,
            accel: accel.as_ref(),
            side: SIDE,
            spp,
            rays,
            camera_rays: BESIDE,
            tile: 32,
        };
        let take = |seed: u32| {
            let picture = shot.take_measured(sampler(spec, &dome, rays).as_mut(), seed);
            let replicates = &picture.film.replicates;
            assert_eq!((replicates.count, picture.spp), (16, spp));
            let stated = replicates.variance().chunks_exact(3).map(|v| f64::from(v.iter().sum::<f32>())).collect();
            (pixels(&picture).iter().map(|p| p.as_dvec3()).collect(), stated)
        };
        let pictures: Vec<(Vec<DVec3>, Vec<f64>)> = (0..SEEDS).into_par_iter().map(take).collect();
        let seeds = f64::from(SEEDS);
        let ratios: Vec<f64> = (0..(SIDE * SIDE) as usize)
            .map(|i| {
                let stated = pictures.iter().map(|(_, v)| v[i]).sum::<f64>() / seeds;
                let mean = pictures.iter().map(|(p, _)| p[i]).sum::<DVec3>() / seeds;
                let found = pictures.iter().map(|(p, _)| (p[i] - mean).length_squared()).sum::<f64>() / (seeds - 1.0);
                found / stated
            })
            .collect();
        let count = ratios.len() as f64;
        let mean = ratios.iter().sum::<f64>() / count;
        let error = (ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (count - 1.0) / count).sqrt();
        println!("{spec} {spp}×{rays}: {mean:.4} ± {error:.4}");
        assert!(
            (mean - 1.0).abs() <= 4.0 * error,
            "{spec}, {spp}×{rays}: pictures spread {mean} ± {error} of what they state"
        );
        assert!(error < 0.02, "{spec}: ± {error} says nothing");
    }
}
