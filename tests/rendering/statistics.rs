//! χ² of every sampler against the density it claims, over domes and normals; and that the test can fail.

use crate::support::samplers::{chi_square, gamma_q, normals, point, sampler, sidak, study_domes, unit};
use domelight::dome::Dome;
use domelight::sampler::{DomeSampler, Draws, Point, SAMPLERS, SamplerStats};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;

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

/// A sampler whose cache took every group's visibility for a number of its own.
fn learned(dome: &Arc<Dome>, normals: &[Vec3]) -> Box<dyn DomeSampler> {
    let mut sampler = sampler("tessellated:cache-block=64", dome, 64);
    let mut draws = Draws::default();
    for (n, seed) in normals.iter().zip(0..) {
        sampler.draw(&point(*n, seed), 64, &mut draws);
        let coin = |(i, &target): (u32, &u32)| u8::from(unit(&[seed, i]) > unit(&[target]));
        let coins: Vec<u8> = (0..).zip(&draws.target).map(coin).collect();
        sampler.observe(&draws.target, &coins);
    }
    sampler.next_stage();
    sampler
}

#[test]
fn so_does_one_that_has_learned() {
    let domes = study_domes();
    let normals = normals(50);
    let threshold = sidak(0.01, domes.len() * normals.len());
    for (name, dome) in &domes {
        // A block holds two records: those of one axis.
        for axis in 0..3 {
            let normals: Vec<Vec3> = normals.iter().copied().filter(|n| n.abs().max_position() == axis).collect();
            assert!(!normals.is_empty());
            let sampler = learned(dome, &normals);
            normals.par_iter().zip(0..normals.len() as u32).for_each(|(n, i)| {
                let mut draws = Draws::default();
                sampler.draw(&point(*n, 1), 64, &mut draws);
                assert!(!draws.control.is_empty(), "dome '{name}', normal {n}: no record");
                match chi_square(sampler.as_ref(), dome, *n, i, DRAWS) {
                    Ok(p) => assert!(p >= threshold, "dome '{name}', normal {n}: p = {p:e} < {threshold:e}"),
                    Err(message) => panic!("dome '{name}', normal {n}: {message}"),
                }
            });
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
