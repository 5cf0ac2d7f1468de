//! The scenes of the repo against what Cycles and POV-Ray make of them (scenes/reference/, where the scripts are that made
//! the pictures). Each limit stands beside one on the error of what it limits: a figure that is not known says nothing.
//! `cargo test --test images references -- --nocapture` shows the table.
//!
//! Where Cycles differs for a reason:
//! - Outside its Principled BSDF nothing dims the diffuse lobe under a dielectric's gloss. What the gloss takes away is
//!   rendered by [`Dimming`] and added to our picture.
//! - Shading normals that face away from the viewer are turned here; there they are left black, or lit from behind. Pixels
//!   of a glossy scene that have one are left out, and so are the few whose value the referee may not know ([`unknown`],
//!   [`Stage::is_missed`]).
//! - Left in: Blender makes a deformed mesh's normals anew, glTF's skins turn those of the file (materials: the elbow of
//!   the rod, up to twice as bright; the rod of `nodes` has facets). Cycles lets no light in from below the interpolated
//!   normal, whatever the normal map says (materials: the bumpy ball's terminator in the sun).

use crate::support::{Agreement, Stage, agreement, read, repo, unknown};
use domelight::accel::Ray;
use domelight::bsdf::Bsdf;
use domelight::hash::sha256_file;
use domelight::integrator::{Integrator, Queue, Shading, World};
use domelight::sampler::{Draws, Point};
use domelight::scene::{CameraChoice, offset_origin};
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;
use std::path::Path;

const SIDE: u32 = 128;

/// ∫ base/π · E(v) · L · V · cos: the light that a dielectric's gloss keeps from the diffuse lobe below it.
#[derive(Debug)]
struct Dimming;

impl Integrator for Dimming {
    fn shade(&self, world: &World<'_>, at: &Shading<'_>, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let (surface, wo) = (at.surface, at.wo);
        let bsdf = Bsdf::new(surface, wo);
        if bsdf.specular.is_none() || surface.unlit {
            return Vec3::ZERO;
        }
        let dimmed = surface.base_color * (1.0 - surface.metallic) - bsdf.diffuse;
        let Shading { pixel, distance, numbers, rays, .. } = *at;
        let point = Point { pixel, distance, ng: surface.ng, ns: surface.ns, wo, bsdf, sunless: false, numbers };
        world.sampler.draw(&point, rays, draws);
        for i in 0..draws.dir.len() {
            let dir = draws.dir.get(i);
            let cosine = dir.dot(surface.ns);
            if cosine <= 0.0 || dir.dot(surface.ng) <= 0.0 {
                continue;
            }
            let weight = FRAC_1_PI * cosine / (draws.pdf[i] * draws.dir.len() as f32);
            let origin = offset_origin(surface.position, surface.error, surface.ng, dir);
            queue.push(Ray::new(origin, dir), draws.radiance.get(i) * dimmed * weight);
        }
        Vec3::ZERO
    }

    fn shows_dome(&self) -> bool {
        false
    }
}

/// Renders a scene of the repo under domes and holds each picture against the referee's.
fn check(scene: &str, referee: &str, domes: &[&str], effort: [u32; 2], judge: impl Fn(&str, &Agreement)) {
    let path = repo(&format!("scenes/{scene}.glb"));
    check_at(&path, &CameraChoice::First, "scenes/reference", referee, domes, effort, judge);
}

fn check_at(
    path: &Path,
    camera: &CameraChoice,
    folder: &str,
    referee: &str,
    domes: &[&str],
    [spp, rays]: [u32; 2],
    judge: impl Fn(&str, &Agreement),
) {
    let stage = Stage::new(path, camera);
    let scene = path.file_stem().unwrap().to_string_lossy();
    let (mut solid, inside) = (stage.solid(SIDE), stage.inside(SIDE));
    let shown = solid.iter().filter(|s| **s).count() as f64;
    if stage.has_gloss() {
        solid.iter_mut().zip(stage.turned(SIDE)).for_each(|(s, turned)| *s &= !turned);
        let left = solid.iter().filter(|s| **s).count() as f64 / shown;
        println!("{scene}: {:.2} % of the pixels have normals that face away", 100.0 * (1.0 - left));
        assert!(left > 0.9, "{scene}: only {left} of the pixels are left");
    }
    for dome in domes {
        let name = format!("{scene}-{dome}-{referee}");
        let (reference, facts) = read(&repo(&format!("{folder}/{name}.exr")));
        let dome = repo(&format!("scenes/{dome}.exr"));
        for (key, file) in [("sceneSha256", path), ("domeSha256", &dome)] {
            let known = facts.iter().any(|(k, v)| k == key && *v == sha256_file(file).unwrap());
            assert!(known, "{name} is of another scene or dome; make it again (scenes/reference/make.py {name})");
        }
        let ours = stage.render(&dome, "tessellated", None, [SIDE, spp, rays]);
        let mut picture = ours.clone();
        if stage.has_gloss() && referee == "cycles" {
            let dimming = stage.render(&dome, "latlong", Some(&Dimming), [SIDE, spp, rays]);
            picture.mean.iter_mut().zip(&dimming.mean).for_each(|(p, d)| *p += *d);
            picture.variance.iter_mut().zip(&dimming.variance).for_each(|(p, d)| *p += *d);
        }
        let mut solid = solid.clone();
        if stage.has_gloss() {
            // Ours is aimed at suns in polished things, the referee's is not: what may be missed shows in one that is not either.
            let evenly = stage.render(&dome, "tessellated:cache=off", None, [SIDE, spp, rays]);
            let mut unknown = unknown(&evenly, &reference);
            for i in (0..unknown.len()).filter(|&i| solid[i]) {
                unknown[i] |= stage.is_missed(i, SIDE, &dome, [&ours, &evenly]);
            }
            let lost = solid.iter().zip(&unknown).filter(|(s, u)| **s && **u).count() as f64 / shown;
            println!("{name}: {:.2} % of the pixels are not known well enough", 100.0 * lost);
            assert!(lost < 0.005, "{name}: {lost} of the pixels are not known well enough");
            solid.iter_mut().zip(unknown).for_each(|(s, unknown)| *s &= !unknown);
        }
        let found = agreement(&picture, &reference, &solid, &inside);
        println!("{name:<32} {found}");
        judge(&name, &found);
    }
}

const DOMES: [&str; 3] = ["overcast_sun", "window", "studio"];

/// Lambertian scenes: every figure.
fn lambertian(scene: &str, effort: [u32; 2]) {
    check(scene, "cycles", &DOMES, effort, |name, found| {
        let ([ratio, error], [relmse, spread]) = (found.ratio, found.relmse);
        assert!((ratio - 1.0).abs() <= 0.001 && error < 0.0004, "{name}: mean ratio {ratio} ± {error}");
        assert!(relmse <= 1e-4 && spread < 3e-5, "{name}: relMSE {relmse:e} ± {spread:e}");
        assert!(found.beyond <= 0.003, "{name}: {} of the pixels beyond 4 σ", found.beyond);
    });
}

#[test]
fn a_sphere_as_cycles_sees_it() {
    lambertian("sphere", [64, 8]);
}

#[test]
fn a_colonnade_as_cycles_sees_it() {
    lambertian("colonnade", [256, 8]);
}

#[test]
fn a_terrain_as_cycles_sees_it() {
    lambertian("terrain", [128, 8]);
}

#[test]
fn mirrored_and_skinned_nodes_as_cycles_sees_them() {
    lambertian("nodes", [64, 8]);
}

#[test]
fn materials_as_cycles_sees_them() {
    check("materials", "cycles", &DOMES, [256, 8], |name, found| {
        let [relmse, spread] = found.relmse;
        assert!(relmse <= 1e-3 && spread < 2e-4, "{name}: relMSE {relmse:e} ± {spread:e}");
    });
}

#[test]
fn soft_light_as_pov_ray_sees_it() {
    for (scene, domes) in
        [("sphere", &["overcast", "studio"][..]), ("colonnade", &["overcast"]), ("terrain", &["overcast"])]
    {
        check(scene, "povray", domes, [16, 8], |name, found| {
            assert!((found.ratio[0] - 1.0).abs() <= 0.004, "{name}: mean ratio {:?}", found.ratio);
        });
    }
}

/// Assets of others, where `scenes/reference/make.py --assets ../shared/assets/gltf` has made their references.
#[test]
fn real_assets_as_cycles_sees_them() {
    for (file, eye, target, fov) in [
        ("Suzanne/Suzanne.gltf", [1.0, 0.6, 4.5], [0.0, 0.0, 0.0], 38.0),
        ("Avocado/Avocado.gltf", [0.05, 0.06, 0.16], [0.0, 0.031, 0.0], 28.0),
        ("SpecularTest.glb", [-0.19, 0.0, 2.0], [-0.19, 0.0, 0.0], 36.0),
        ("VertexColorTest.glb", [0.3, 0.2, 4.0], [0.0, 0.0, 0.0], 36.0),
    ] {
        let path = repo("../shared/assets/gltf").join(file);
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let known = |dome: &&str| repo(&format!("target/references/{name}-{dome}-cycles.exr")).exists();
        if !path.exists() || !DOMES.iter().all(known) {
            eprintln!("skipped: {name} or its references are not here");
            continue;
        }
        let camera = CameraChoice::LookAt { eye: eye.into(), target: target.into(), fov };
        check_at(&path, &camera, "target/references", "cycles", &DOMES, [256, 8], |name, found| {
            let [relmse, spread] = found.relmse;
            assert!(relmse <= 1e-3 && spread < 2e-4, "{name}: relMSE {relmse:e} ± {spread:e}");
        });
    }
}
