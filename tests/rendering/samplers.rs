//! Every sampler estimates the irradiance of every odd dome without bias, and reports the densities it drew with.

use crate::support::samplers::{cosines, dome, normals, point, sampler, shares, sound, study_domes, texels_near};
use domelight::dome::Dome;
use domelight::random::hash;
use domelight::sampler::{DomeSampler, Draws};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::sync::Arc;

const RAYS: u32 = 16;
const BATCHES: u32 = 1024;

fn odd_domes() -> Vec<(&'static str, Arc<Dome>)> {
    let mut list = study_domes();
    let hot = |at: (u32, u32)| dome(64, 32, move |x, y| if (x, y) == at { [3e5, 2e5, 1e5] } else { [0.1, 0.2, 0.3] });
    list.extend([
        ("black", dome(8, 4, |_, _| [0.0; 3])),
        ("2×1", dome(2, 1, |x, _| [1.0, x as f32, 0.0])),
        ("odd", dome(37, 19, |x, y| [(x * y % 11) as f32, (x % 3) as f32, (y % 5) as f32])),
        ("hot at the zenith", hot((5, 0))),
        ("hot at the nadir", hot((40, 31))),
        ("hot before the seam", hot((63, 12))),
        ("hot after the seam", hot((0, 13))),
        ("pure blue", dome(16, 8, |x, y| [0.0, 0.0, if (x, y) == (3, 2) { 50.0 } else { 0.01 }])),
        ("one lit texel", dome(16, 8, |x, y| if (x, y) == (9, 3) { [1.0; 3] } else { [0.0; 3] })),
    ]);
    list
}

/// Mean and standard error of the estimates of independent batches.
fn summarise(values: &[DVec3]) -> (DVec3, DVec3) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<DVec3>() / count;
    let square = values.iter().map(|v| (*v - mean) * (*v - mean)).sum::<DVec3>() / (count - 1.0);
    (mean, (square / count).map(f64::sqrt))
}

fn assert_unbiased(what: &str, dome: &Dome, n: Vec3, values: &[DVec3], shares: &[f64]) {
    let (mut exact, mut rare) = (DVec3::ZERO, DVec3::ZERO);
    for ((texel, cosine), share) in dome.texels.iter().zip(cosines(&dome.grid, n)).zip(shares) {
        let light = Vec3::from(*texel).as_dvec3() * cosine;
        exact += light;
        // What is met a few times in all makes neither a mean nor an error to trust.
        let met = share * f64::from(RAYS * BATCHES);
        assert!(light == DVec3::ZERO || met > 0.0 || cosine < 1e-5, "{what}, normal {n}: light that is never drawn");
        if met < 50.0 {
            rare += light;
        }
    }
    let (mean, error) = summarise(values);
    // What quadrature and f32 may differ by where there is no noise at all.
    let slack = exact * 2e-4 + 1e-6 + rare;
    for k in 0..3 {
        let off = (mean[k] - exact[k]).abs();
        assert!(off <= 4.0 * error[k] + slack[k], "{what}, normal {n}: {mean} is not {exact} (± {error})");
    }
}

/// One batch's estimate of the irradiance.
fn estimate(draws: &Draws, n: Vec3) -> DVec3 {
    let count = draws.dir.len() as f64;
    let value = |i: usize| {
        let cosine = f64::from(n.dot(draws.dir.get(i)).max(0.0));
        let control = draws.control.get(i).map_or(0.0, |&control| f64::from(control));
        draws.radiance.get(i).as_dvec3() * (cosine - control) / f64::from(draws.pdf[i])
    };
    let integral = if draws.control.is_empty() { DVec3::ZERO } else { draws.integral.as_dvec3() };
    integral + (0..draws.dir.len()).map(value).sum::<DVec3>() / count
}

#[test]
fn every_sampler_estimates_every_dome_without_bias() {
    for spec in sound() {
        for (name, dome) in &odd_domes() {
            let sampler = sampler(spec, dome, RAYS);
            normals(14).par_iter().enumerate().for_each(|(k, n)| {
                let mut draws = Draws::default();
                let values: Vec<_> = (0..BATCHES)
                    .map(|batch| {
                        sampler.draw(&point(*n, hash(&[7, k as u32, batch])), RAYS, &mut draws);
                        assert!((1..=RAYS as usize).contains(&draws.dir.len()));
                        estimate(&draws, *n)
                    })
                    .collect();
                let shares = shares(sampler.as_ref(), &dome.grid, &point(*n, 0), &draws);
                assert_unbiased(&format!("{spec}, dome '{name}'"), dome, *n, &values, &shares);
            });
        }
    }
}

/// MIS compensation draws nothing from the even part of the sky: it is sound beside cosine sampling.
#[test]
fn compensated_sampling_beside_the_cosine_is_without_bias() {
    for (name, dome) in &odd_domes() {
        let pair = ["latlong:mis", "cosine"].map(|spec| sampler(spec, dome, RAYS / 2));
        normals(14).par_iter().enumerate().for_each(|(k, n)| {
            let mut draws = [Draws::default(), Draws::default()];
            let values: Vec<_> = (0..BATCHES)
                .map(|batch| {
                    let mut sum = DVec3::ZERO;
                    for (s, (sampler, draws)) in pair.iter().zip(&mut draws).enumerate() {
                        let point = point(*n, hash(&[9, k as u32, batch, s as u32]));
                        sampler.draw(&point, RAYS / 2, draws);
                        for (i, dir) in draws.dir.iter().enumerate() {
                            let other = pair[1 - s].pdf(&point, draws, dir, dome.grid.texel(dir));
                            let light = draws.radiance.get(i).as_dvec3() * f64::from(n.dot(dir).max(0.0));
                            sum += light / f64::from(draws.pdf[i] + other);
                        }
                    }
                    sum / f64::from(RAYS / 2)
                })
                .collect();
            let [a, b] = [0, 1].map(|s| shares(pair[s].as_ref(), &dome.grid, &point(*n, 0), &draws[s]));
            let shares: Vec<_> = a.iter().zip(&b).map(|(a, b)| 0.5 * (a + b)).collect();
            assert_unbiased(&format!("latlong:mis + cosine, dome '{name}'"), dome, *n, &values, &shares);
        });
    }
}

fn check_reports(spec: &str, sampler: &dyn DomeSampler, dome: &Dome, n: Vec3) {
    let mut draws = Draws::default();
    for seed in 0..64 {
        let point = point(n, seed);
        sampler.draw(&point, RAYS, &mut draws);
        assert_eq!(draws.dir.len(), draws.pdf.len());
        assert_eq!(draws.dir.len(), draws.radiance.len());
        assert!(draws.control.is_empty() || draws.control.len() == draws.dir.len());
        for (i, dir) in draws.dir.iter().enumerate() {
            if dir == -n && draws.radiance.get(i) == Vec3::ZERO {
                continue; // The draw that found no light.
            }
            let near = texels_near(&dome.grid, dir);
            // A sampler's own cells may be finer than texels: rounding may put a direction just across their border.
            let nudged = [Vec3::ZERO, Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
            let agrees = |texel: &&u32| {
                let pdf = |nudge: &Vec3| sampler.pdf(&point, &draws, (dir + nudge * 1e-6).normalize(), **texel);
                nudged.iter().any(|nudge| (pdf(nudge) - draws.pdf[i]).abs() <= 1e-4 * draws.pdf[i])
            };
            let found = near
                .iter()
                .filter(agrees)
                .any(|texel| dome.texels[*texel as usize] == draws.radiance.get(i).to_array());
            let claims: Vec<_> = near.iter().map(|t| sampler.pdf(&point, &draws, dir, *t)).collect();
            assert!(found, "{spec}, normal {n}: drew {dir} with density {}, pdf() says {claims:?}", draws.pdf[i]);
        }
    }
}

#[test]
fn densities_and_radiance_are_those_of_the_texel_that_was_drawn() {
    for spec in sound().chain(["latlong:mis"]) {
        for (_, dome) in &odd_domes() {
            let sampler = sampler(spec, dome, RAYS);
            normals(14).iter().for_each(|n| check_reports(spec, sampler.as_ref(), dome, *n));
        }
    }
}

#[test]
fn the_same_numbers_give_the_same_directions() {
    let (_, dome) = &study_domes()[3];
    for spec in sound() {
        let (a, b) = (sampler(spec, dome, RAYS), sampler(spec, dome, RAYS));
        let (mut first, mut second) = (Draws::default(), Draws::default());
        for seed in 0..8 {
            a.draw(&point(Vec3::X, seed), RAYS, &mut first);
            b.draw(&point(Vec3::X, seed), RAYS, &mut second);
            assert_eq!((&first.dir, &first.pdf), (&second.dir, &second.pdf), "{spec}");
        }
    }
}
