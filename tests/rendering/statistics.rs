//! χ² of every sampler against the density it claims, over domes and normals; and that the test can fail.

use crate::support::samplers::{chi_square, gamma_q, normals, sampler, sidak, study_domes};
use domelight::sampler::{DomeSampler, Draws, Point, SAMPLERS, SamplerStats};
use glam::Vec3;
use rayon::prelude::*;

const DRAWS: u32 = 8192;

#[test]
fn every_sampler_draws_by_the_density_it_claims() {
    let domes = study_domes();
    let normals = normals(50);
    let specs: Vec<&str> = SAMPLERS.iter().map(|p| p.name).chain(["latlong:mis"]).collect();
    let threshold = sidak(0.01, specs.len() * domes.len() * normals.len());
    for spec in specs {
        for (name, dome) in &domes {
            let sampler = sampler(spec, dome, 64);
            let runs: Vec<_> = normals
                .par_iter()
                .enumerate()
                .map(|(i, n)| (n, chi_square(sampler.as_ref(), dome, *n, i as u32, DRAWS)))
                .collect();
            for (n, result) in runs {
                match result {
                    Ok(p) => assert!(p >= threshold, "{spec}, dome '{name}', normal {n}: p = {p:e} < {threshold:e}"),
                    Err(message) => panic!("{spec}, dome '{name}', normal {n}: {message}"),
                }
            }
        }
    }
}

/// Claims a density that is 20 % too high towards +X and too low towards −X.
#[derive(Debug)]
struct Liar(Box<dyn DomeSampler>);

impl Liar {
    fn lie(dir: Vec3) -> f32 {
        if dir.x > 0.0 { 1.2 } else { 0.8 }
    }
}

impl DomeSampler for Liar {
    fn draw(&self, point: &Point, n: u32, out: &mut Draws) {
        self.0.draw(point, n, out);
    }
    fn pdf(&self, point: &Point, drawn: &Draws, dir: Vec3, texel: u32) -> f32 {
        self.0.pdf(point, drawn, dir, texel) * Self::lie(dir)
    }
    fn stats(&self) -> SamplerStats {
        self.0.stats()
    }
}

#[test]
fn a_sampler_that_lies_is_found_out() {
    let (name, dome) = &study_domes()[0];
    for spec in ["latlong", "cosine"] {
        let liar = Liar(sampler(spec, dome, 64));
        let p = chi_square(&liar, dome, Vec3::Y, 1, DRAWS).unwrap();
        assert!(p < sidak(0.01, 1500), "{spec}, {name}: p = {p}");
    }
}

#[test]
fn the_chi_square_distribution_has_its_tabled_quantiles() {
    for (freedom, quantile, p) in
        [(1.0, 3.841, 0.05), (10.0, 18.307, 0.05), (100.0, 135.807, 0.01), (500.0, 603.446, 0.001)]
    {
        let found: f64 = gamma_q(freedom / 2.0, quantile / 2.0);
        assert!((found / p - 1.0).abs() < 2e-3, "{freedom} {quantile}: {found}");
    }
}
