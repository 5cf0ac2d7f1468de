//! What is called most, each by itself: `cargo bench --bench kernels`, or with a part of a name after `--`.
#![allow(missing_docs, reason = "criterion's macros make public items")]

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use domelight::accel::{self, ACCELS, Coherence, Hit, Mask, Ray};
use domelight::bsdf::{Bsdf, Specular, ggx};
use domelight::dome::project::Grid;
use domelight::dome::{self, Dome, Faults};
use domelight::random::{hash, sobol2, unit};
use domelight::registry::resolve;
use domelight::sampler::{Draws, Numbers, Point, SAMPLERS, Setup};
use domelight::scene::{self, LoadOptions, Scene};
use glam::Vec3;
use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;

const RAYS: usize = 256;
const DIRECTIONS: u32 = 64;

fn scene() -> Arc<Scene> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/colonnade.glb");
    Arc::new(scene::load(&path, &LoadOptions::default()).expect("a scene of the repository"))
}

fn dome() -> Arc<Dome> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/overcast_sun.exr");
    Arc::new(dome::load(&path, 0.0, 1.0).expect("a dome of the repository"))
}

/// The same dome as an image of the size that artists use, no two texels of it alike.
fn large() -> Arc<Dome> {
    let small = dome();
    let grid = Grid::new(4096, 2048, 0.0);
    let (wide, high) = (grid.width / small.grid.width, grid.height / small.grid.height);
    let texel = |i: u32| {
        let (x, y) = (i % grid.width / wide, i / grid.width / high);
        small.texels[(y * small.grid.width + x) as usize].map(|value| value * (0.75 + 0.5 * unit(hash(&[i]))))
    };
    Arc::new(Dome { grid, texels: (0..grid.len() as u32).map(texel).collect(), faults: Faults::default() })
}

fn direction(i: u32) -> Vec3 {
    let (z, angle) = (2.0 * unit(hash(&[i, 1])) - 1.0, std::f32::consts::TAU * unit(hash(&[i, 2])));
    let ring = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(ring * angle.cos(), z, ring * angle.sin())
}

/// Rays from within the scene to anywhere, a batch of them.
fn accelerators(c: &mut Criterion) {
    let scene = scene();
    let [low, high] = scene.bounds;
    let at = |i: u32| low + (high - low) * Vec3::new(unit(hash(&[i, 3])), unit(hash(&[i, 4])), unit(hash(&[i, 5])));
    let rays: Vec<Ray> = (0..RAYS as u32).map(|i| Ray::new(at(i), direction(i))).collect();
    let mut group = c.benchmark_group("rays");
    group.throughput(Throughput::Elements(RAYS as u64));
    let kernels = ["bvh:isa=portable", "bvh:isa=avx2"];
    let plugins = ACCELS.iter().map(|plugin| plugin.name).filter(|name| *name != "brute");
    for spec in plugins.chain(kernels) {
        // Vector code that this processor lacks.
        let Ok(accel) = accel::build(spec, &scene, 1) else { continue };
        let (mut hits, mut occluded) = ([Hit::MISS; RAYS], [0u8; RAYS]);
        group.bench_function(BenchmarkId::new("any-hit", spec), |b| {
            b.iter(|| accel.occluded(black_box(&rays), Mask::All, &mut occluded));
        });
        group.bench_function(BenchmarkId::new("closest-hit", spec), |b| {
            b.iter(|| accel.intersect(black_box(&rays), Mask::All, Coherence::Incoherent, &mut hits));
        });
    }
}

/// The directions of a point, for one normal after the other.
fn samplers(c: &mut Criterion) {
    let (dome, large) = (dome(), large());
    let mut group = c.benchmark_group("directions");
    group.throughput(Throughput::Elements(DIRECTIONS.into()));
    let specs = SAMPLERS.iter().map(|plugin| plugin.name).chain(["tessellated:cache=off"]);
    for (spec, dome) in specs.flat_map(|spec| [(spec, &dome), (spec, &large)]) {
        let (plugin, params) = resolve("sampler", SAMPLERS, spec).expect("a registered sampler");
        let setup = Setup { size: [640, 480], gloss: false, rays: DIRECTIONS, spp: 16 };
        let sampler = (plugin.make)(dome, &params, &setup).expect("options by default");
        let (mut draws, mut i) = (Draws::default(), 0);
        group.bench_function(BenchmarkId::new(spec, dome.grid.width), |b| {
            b.iter(|| {
                i += 1;
                let n = direction(i);
                let point = Point {
                    pixel: [i % 640, i / 640 % 480],
                    distance: 3.0,
                    ng: n,
                    ns: n,
                    wo: n,
                    bsdf: Bsdf { diffuse: Vec3::ONE, specular: None },
                    sunless: false,
                    numbers: Numbers { seed: hash(&[i]), sample: 0 },
                };
                sampler.draw(&point, DIRECTIONS, &mut draws);
            });
        });
    }
}

fn shading(c: &mut Criterion) {
    let dome = dome();
    let mut i = 0;
    c.bench_function("dome look-up", |b| {
        b.iter(|| {
            i += 1;
            dome.lookup(black_box(direction(i)))
        });
    });
    let lobe = Specular { alpha: 0.2, f0: Vec3::splat(0.04), f90: 1.0 };
    let wo = Vec3::new(0.6, 0.0, 0.8);
    c.bench_function("ggx sample", |b| {
        b.iter(|| {
            i += 1;
            ggx::sample(&lobe, black_box(wo), sobol2(i, 7).map(unit))
        });
    });
}

criterion_group!(kernels, accelerators, samplers, shading);
criterion_main!(kernels);
