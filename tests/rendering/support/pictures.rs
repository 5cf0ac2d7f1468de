//! Sets of pictures that differ by their seed, held against each other pixel by pixel; and what is seen in them.

use super::render::{BESIDE, Shot, cuboid, pixels, scene, square, white};
use super::samplers::{dome, sampler, unit};
use domelight::accel::{self, Accel};
use domelight::dome::Dome;
use domelight::metrics::ztest::{Estimate, z_test};
use domelight::sampler::DomeSampler;
use domelight::scene::{Camera, CameraChoice, Material, Mesh, Scene};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::sync::{Arc, LazyLock};

pub(crate) const SIDE: u32 = 32;
pub(crate) const SEEDS: u32 = 64;
pub(crate) const CACHE: &str = "tessellated:cache-block=4,groups=128,triangles=1024";

/// A floor under slats beside a block.
pub(crate) fn occluders() -> Vec<(Mesh, Material)> {
    let mut parts = vec![(square(Vec3::ZERO, Vec3::Y, 4.0), white())];
    parts.push((cuboid(Vec3::new(-0.9, 0.0, -0.5), Vec3::new(-0.3, 0.9, 0.2)), white()));
    for i in 0..5 {
        let z = 0.3 * i as f32 - 0.4;
        parts.push((cuboid(Vec3::new(0.2, 0.8, z), Vec3::new(1.4, 0.9, z + 0.12)), white()));
    }
    parts
}

/// A sun of a texel in an uneven sky.
pub(crate) fn sun() -> Arc<Dome> {
    let sky = |x: u32, y: u32| [0.4, 0.5, 0.7].map(|c| (c * (0.5 + unit(&[x, y]))) as f32);
    dome(64, 32, |x, y| if (x, y) == (20, 7) { [900.0, 800.0, 600.0] } else { sky(x, y) })
}

/// A sky without a sun, soft enough for uniform directions.
pub(crate) fn soft() -> Arc<Dome> {
    dome(64, 32, |x, y| [1.0 + (x as f32 * 0.1).sin(), 1.0, if y < 16 { 1.5 } else { 0.2 }])
}

/// Something to render: a scene, its structure, its camera.
pub(crate) struct Stage {
    pub(crate) scene: Arc<Scene>,
    pub(crate) accel: Box<dyn Accel>,
    pub(crate) camera: Camera,
}

impl Stage {
    pub(crate) fn new(parts: Vec<(Mesh, Material)>) -> Self {
        let scene = scene(parts);
        let accel = accel::build("bvh", &scene, 2).unwrap();
        let eye = Vec3::new(0.6, 2.0, 3.2);
        let camera = CameraChoice::LookAt { eye, target: Vec3::new(0.2, 0.3, 0.0), fov: 40.0 };
        let camera = camera.resolve(&scene, 1.0).unwrap();
        Self { scene, accel, camera }
    }
    pub(crate) fn shot<'a>(&'a self, dome: &'a Arc<Dome>, spp: u32, rays: u32) -> Shot<'a> {
        Shot {
            scene: &self.scene,
            dome,
            camera: &self.camera,
            accel: self.accel.as_ref(),
            side: SIDE,
            spp,
            rays,
            camera_rays: BESIDE,
            tile: 32,
        }
    }
}

/// Means and variances of the means over independent pictures.
pub(crate) struct Pictures {
    pub(crate) mean: Vec<Vec3>,
    pub(crate) variance: Vec<Vec3>,
    /// The whole picture's mean and its standard error.
    pub(crate) whole: (f64, f64),
}

impl Pictures {
    pub(crate) fn estimate(&self) -> Estimate<'_> {
        Estimate { mean: &self.mean, variance: &self.variance, freedom: f64::from(SEEDS - 1) }
    }
}

pub(crate) fn summarise(pictures: &[Vec<Vec3>]) -> Pictures {
    let count = pictures.len() as f64;
    let at = |i: usize| pictures.iter().map(move |p| p[i].as_dvec3());
    let means: Vec<DVec3> = (0..pictures[0].len()).map(|i| at(i).sum::<DVec3>() / count).collect();
    let variance = |(i, mean): (usize, &DVec3)| {
        let square: DVec3 = at(i).map(|v| (v - *mean) * (v - *mean)).sum();
        (square / (count * (count - 1.0))).as_vec3()
    };
    let variance = means.iter().enumerate().map(variance).collect();
    let wholes: Vec<f64> = pictures.iter().map(|p| p.iter().map(|v| f64::from(v.element_sum())).sum::<f64>()).collect();
    let whole = wholes.iter().sum::<f64>() / count;
    let spread = wholes.iter().map(|w| (w - whole).powi(2)).sum::<f64>();
    let whole = (whole, (spread / (count * (count - 1.0))).sqrt());
    Pictures { mean: means.iter().map(|mean| mean.as_vec3()).collect(), variance, whole }
}

/// Pictures of one seed each. A sampler, dear to make, takes eight of them and is led astray before each; what it has
/// seen before reaches a picture through the cache alone, so that pictures stay uncorrelated.
pub(crate) fn take(
    shot: &Shot<'_>,
    first: u32,
    make: impl Fn() -> Box<dyn DomeSampler> + Sync,
    mislead: impl Fn(&mut dyn DomeSampler, u32) + Sync,
) -> Pictures {
    let several = |batch: u32| {
        let mut sampler = make();
        let picture = |seed| {
            mislead(sampler.as_mut(), seed);
            pixels(&shot.take(sampler.as_mut(), seed))
        };
        (first + 8 * batch..first + 8 * batch + 8).map(picture).collect::<Vec<_>>()
    };
    summarise(&(0..SEEDS / 8).into_par_iter().flat_map(several).collect::<Vec<_>>())
}

/// Sun and slats by a sampler that has nothing in common with the one under test.
pub(crate) static BRUTE_FORCE: LazyLock<Pictures> = LazyLock::new(|| {
    let dome = sun();
    take(&Stage::new(occluders()).shot(&dome, 16, 32), 1000, || sampler("latlong", &dome, 32), |_, _| ())
});

pub(crate) fn assert_same(what: &str, pictures: &Pictures, reference: &Pictures) {
    // Variances are of sixty-four pictures: Student's tails are heavier, 0.001 of the normal's is 0.005 of theirs.
    let test = z_test(pictures.estimate(), reference.estimate(), 0.001);
    assert!(test.passes(), "{what}: {test:?}");
    // z² has a mean of about 1, whatever the cache holds; less where pixels agree to rounding.
    assert!((0.7..1.1).contains(&test.spread), "{what}: {test:?}");
    let ((a, e), (b, f)) = (pictures.whole, reference.whole);
    assert!(
        (a - b).abs() <= 4.0 * e.hypot(f),
        "{what}: the whole picture is {} ± {} of what it should be",
        a / b,
        e.hypot(f) / b
    );
}
