//! Materials: furnaces over the roughness × metallic grid, and every parameter at its ends.

use crate::shot::{Shot, colors};
use crate::support::formula::reflected;
use crate::support::render::{microscope, scene, square, white};
use crate::support::samplers::dome;
use domelight::dome::Dome;
use domelight::scene::Material;
use glam::{DVec3, Vec3, Vec4};
use rayon::prelude::*;
use std::sync::Arc;

fn furnace() -> Arc<Dome> {
    dome(64, 32, |_, _| [1.0; 3])
}

/// A point of this material about +Z seen from `degrees` off its normal.
fn seen(material: &Material, dome: &Arc<Dome>, degrees: f64, shot: Shot) -> (DVec3, DVec3) {
    let wo = towards(degrees).as_vec3();
    let scene = scene(vec![(square(Vec3::ZERO, Vec3::Z, 1e-3), material.clone())]);
    shot.mean(&scene, dome, &microscope(Vec3::ZERO, wo, 1e-2))
}

fn towards(degrees: f64) -> DVec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    DVec3::new(0.8 * sin, 0.6 * sin, cos)
}

fn base(value: f32) -> Vec4 {
    Vec4::new(value, value, value, 1.0)
}

/// Goes wrong with: a table of lit texels that has no entry.
#[test]
fn a_black_dome_shows_nothing_in_a_lobe() {
    let black = dome(64, 32, |_, _| [0.0; 3]);
    for (metallic, roughness) in [(0.0, 0.3), (1.0, 0.3), (1.0, 0.0), (0.98, 1.0)] {
        let material = Material { metallic, roughness, ..Material::default() };
        for sampler in ["tessellated", "tessellated:cache=off", "tessellated:mode=seed", "latlong", "latlong:mis"] {
            let (mean, _) = seen(&material, &black, 30.0, Shot { sampler, ..Shot::default() });
            assert_eq!(mean, DVec3::ZERO, "{sampler}, metallic {metallic}, roughness {roughness}");
        }
    }
}

/// White in a white sky: nothing gains light. Goes wrong with: a lobe whose density and value differ, light counted by
/// both strategies, a diffuse lobe that is not dimmed by what the gloss above it reflects.
///
/// A dielectric balances; a metal loses what bounces between its facets, as the specification's model does.
#[test]
fn furnaces_over_the_roughness_and_metallic_grid() {
    let cases: Vec<(f32, f32, f64)> = [0.0, 0.1, 0.25, 0.5, 0.75, 1.0]
        .into_iter()
        .flat_map(|roughness| [0.0, 0.5, 1.0].map(|metallic| (roughness, metallic)))
        .flat_map(|(roughness, metallic)| [0.0, 45.0, 80.0].map(|degrees| (roughness, metallic, degrees)))
        .collect();
    let rows: Vec<_> = cases
        .par_iter()
        .map(|&(roughness, metallic, degrees)| {
            let material = Material { base_color: Vec4::ONE, metallic, roughness, ..Material::default() };
            let shot = Shot { spp: 32, rays: 64, ..Shot::default() };
            let (mean, error) = seen(&material, &furnace(), degrees, shot);
            // A mirror's lobe is too narrow for the integral over cells; it loses nothing.
            let exact = reflected(DVec3::ONE, metallic.into(), roughness.max(0.02).into(), towards(degrees), |_| 1.0);
            (roughness, metallic, degrees, mean.x, error.x, exact.x)
        })
        .collect();
    println!("roughness metallic view  rendered ± error   formula");
    for &(roughness, metallic, degrees, mean, error, exact) in &rows {
        println!("{roughness:9} {metallic:8} {degrees:3}°  {mean:.4} ± {error:.4}   {exact:.4}");
    }
    for (roughness, metallic, degrees, mean, error, exact) in rows {
        let what = format!("roughness {roughness}, metallic {metallic}, {degrees}°");
        assert!((mean - exact).abs() <= 4.5 * error + 2e-3, "{what}: {mean} ± {error} is not {exact}");
        assert!(error < 0.01, "{what}: ± {error} says nothing");
        assert!(mean <= 1.0 + 4.5 * error + 1e-4, "{what}: {mean} ± {error} is more than came in");
        if metallic == 0.0 {
            assert!(mean >= 1.0 - 4.5 * error - 1e-3, "{what}: {mean} ± {error} is less than came in");
        }
    }
}

/// Goes wrong with: α = 0 in a denominator, a lobe narrower than its half vectors, 0/0 for black.
#[test]
fn every_parameter_at_its_ends() {
    let dome = dome(64, 32, |x, y| [if (x, y) == (20, 6) { 1e5 } else { 0.3 + (y % 5) as f32 }; 3]);
    for base_color in [0.0, 1.0, 5.0].map(base) {
        for (metallic, roughness, ior, specular) in [0.0f32, 1.0]
            .into_iter()
            .flat_map(|m| [0.0f32, 1e-3, 1.0].map(|r| (m, r)))
            .flat_map(|(m, r)| [(0.0, 1.0), (1.0, 1.0), (1.5, 0.0), (1e9, 1.0)].map(|(i, s)| (m, r, i, s)))
        {
            let material = Material { base_color, metallic, roughness, ior, specular, ..Material::default() };
            for sampler in ["tessellated", "latlong:mis", "cosine"] {
                for degrees in [0.0, 89.9] {
                    let shot = Shot { sampler, spp: 4, ..Shot::default() };
                    let (mean, _) = seen(&material, &dome, degrees, shot);
                    let what = format!("{material:?}, {sampler}, {degrees}°");
                    // The method's estimates may be negative, their mean hardly.
                    assert!(
                        mean.is_finite() && mean.min_element() > -1.0 && mean.max_element() < 1e6,
                        "{what}: {mean}"
                    );
                    let nothing = base_color.x == 0.0 && (metallic == 1.0 || specular == 0.0);
                    if nothing && (metallic == 0.0 || degrees == 0.0) {
                        assert!(mean.max_element() < 2.0, "{what}: {mean} from black");
                    }
                }
            }
        }
    }
}

/// Goes wrong with: an index of 1 that still reflects, one of 0 or of a mirror that divides by nothing or gains light.
/// Black and smooth, seen along its normal, a surface reflects ((ior − 1) / (ior + 1))² of a white sky.
#[test]
fn the_index_of_refraction_at_its_ends() {
    for (ior, exact) in [(1.0, 0.0), (1.5, 0.04), (1e9, 1.0), (0.0, 1.0)] {
        let material = Material { base_color: base(0.0), metallic: 0.0, roughness: 0.0, ior, ..Material::default() };
        for sampler in ["tessellated", "latlong"] {
            let (mean, error) = seen(&material, &furnace(), 0.0, Shot { sampler, spp: 32, ..Shot::default() });
            let off = (mean.x - exact).abs();
            assert!(off <= 4.5 * error.x + 1e-4, "ior {ior}, {sampler}: {mean} ± {error} is not {exact}");
            assert!(error.x < 0.01, "ior {ior}, {sampler}: ± {error} says nothing");
        }
    }
}

/// Goes wrong with: a black that is not 0, a colour above 1 that is clamped or squared.
#[test]
fn light_is_linear_in_the_base_colour() {
    for sampler in ["tessellated", "tessellated:cache=off", "latlong", "cosine"] {
        let shot = Shot { sampler, ..Shot::default() };
        let value = |v: f32| seen(&Material { base_color: base(v), ..white() }, &furnace(), 30.0, shot).0.x;
        let one = value(1.0);
        assert_eq!(value(0.0), 0.0, "{sampler}");
        for v in [0.25, 4.0, 1024.0] {
            // The same random numbers: the same estimate but for rounding.
            assert!((value(v) / (f64::from(v) * one) - 1.0).abs() < 1e-5, "{sampler}: {v}");
        }
    }
}

/// Goes wrong with: a mirror's direction looked up in another texel than the one it points to.
#[test]
fn a_perfect_mirror_shows_the_dome() {
    let dome = dome(64, 32, |x, y| [(x + 1) as f32, (y + 1) as f32, ((x * y) % 7) as f32]);
    let mirror = Material { base_color: Vec4::ONE, metallic: 1.0, roughness: 0.0, ..Material::default() };
    for degrees in [5.0, 33.0, 71.0] {
        let wo = towards(degrees);
        let reflection = DVec3::new(-wo.x, -wo.y, wo.z).as_vec3();
        let exact = dome.lookup(reflection).0.as_dvec3();
        for sampler in ["tessellated", "latlong"] {
            let (mean, error) = seen(&mirror, &dome, degrees, Shot { sampler, spp: 4, ..Shot::default() });
            // f90 is 1 as f0 is: nothing is lost.
            let off = (mean - exact).abs();
            assert!(
                off.cmple(4.5 * error + 2e-3 * exact).all(),
                "{degrees}°, {sampler}: {mean} ± {error} is not {exact}"
            );
        }
    }
}

/// Goes wrong with: emission that noise is added to, or that is added once a ray instead of once a sample.
#[test]
fn emission_of_1e5_is_exact() {
    let lamp = Material { emission: Vec3::new(1e5, 1.0, 0.0), base_color: base(0.0), ..white() };
    let scene = scene(vec![(square(Vec3::ZERO, Vec3::Z, 1e-3), lamp)]);
    for rays in [1, 16] {
        let picture = Shot { rays, ..Shot::default() }.take(&scene, &furnace(), &microscope(Vec3::ZERO, Vec3::Z, 1e-2));
        assert!(colors(&picture).iter().all(|p| *p == DVec3::new(1e5, 1.0, 0.0)));
    }
}
