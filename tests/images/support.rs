//! Scenes of the repo rendered, references read, and what there is to say about the two.

use domelight::accel::{self, Accel, Coherence, Hit, Mask, Ray};
use domelight::dome;
use domelight::film::Filter;
use domelight::integrator::{INTEGRATORS, Integrator};
use domelight::metrics::ztest::deviate;
use domelight::output;
use domelight::registry::resolve;
use domelight::render::{Background, Render, Settings, Watch};
use domelight::sampler::{SAMPLERS, Setup};
use domelight::scene::{self, Camera, CameraChoice, LoadOptions, Scene, View};
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A file of the repo.
pub(crate) fn repo(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// A square picture with the variance of its pixels' means.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    pub(crate) mean: Vec<Vec3>,
    pub(crate) variance: Vec<Vec3>,
    /// Degrees of freedom of the variances.
    pub(crate) freedom: f64,
}

/// Reads a reference; the header's facts beside it.
pub(crate) fn read(path: &Path) -> (Picture, Vec<(String, String)>) {
    let frame = output::read(path).unwrap();
    let colours = |name: &str| -> Vec<Vec3> {
        let layer = frame.layers.iter().find(|l| l.name == name).unwrap();
        layer.pixels.chunks_exact(layer.channels.len()).map(Vec3::from_slice).collect()
    };
    let replicates = frame.metadata.iter().find(|(key, _)| key == "replicates").unwrap();
    let freedom = replicates.1.parse::<f64>().unwrap() - 1.0;
    (Picture { mean: colours(""), variance: colours("variance"), freedom }, frame.metadata.clone())
}

/// Scene, camera and structure of an asset.
pub(crate) struct Stage {
    scene: Arc<Scene>,
    camera: Camera,
    accel: Box<dyn Accel>,
}

impl Stage {
    pub(crate) fn new(path: &Path, camera: &CameraChoice) -> Self {
        let scene = Arc::new(scene::load(path, &LoadOptions::default()).unwrap());
        let camera = camera.resolve(&scene, 1.0).unwrap();
        let accel = accel::build(accel::ACCELS[0].name, &scene, 2).unwrap();
        Self { scene, camera, accel }
    }

    /// Whether any material has a specular lobe.
    pub(crate) fn has_gloss(&self) -> bool {
        self.scene.needs.gloss
    }

    /// Renders the stage under a dome with variances; `with` replaces the integrator.
    pub(crate) fn render(
        &self,
        dome: &Path,
        sampler: &str,
        with: Option<&dyn Integrator>,
        effort @ [side, ..]: [u32; 3],
    ) -> Picture {
        self.render_part([0, 0, side, side], dome, sampler, with, effort)
    }

    /// The same of some columns and rows.
    pub(crate) fn render_part(
        &self,
        crop: [u32; 4],
        dome: &Path,
        sampler: &str,
        with: Option<&dyn Integrator>,
        [side, spp, rays]: [u32; 3],
    ) -> Picture {
        let dome = Arc::new(dome::load(dome, 0.0, 1.0).unwrap());
        let (make, params) = resolve("sampler", SAMPLERS, sampler).unwrap();
        let setup = Setup { size: [side; 2], gloss: self.scene.needs.gloss, rays, spp };
        let mut sampler = (make.make)(&dome, &params, &setup).unwrap();
        let (make, params) = resolve("integrator", INTEGRATORS, "direct").unwrap();
        let direct = (make.make)(&params).unwrap();
        let settings = Settings {
            size: [side; 2],
            crop,
            spp,
            rays,
            camera_rays: None,
            seed: 1,
            tile: 32,
            filter: Filter::Box,
            background: Background::Dome,
            aovs: false,
            variance: true,
            time: None,
        };
        let view = View::new(&self.camera, side, side);
        let integrator = with.unwrap_or(direct.as_ref());
        let (scene, accel) = (&self.scene, self.accel.as_ref());
        let render = Render { scene, accel, dome: &dome, integrator, view: &view, settings };
        let picture = render.run(sampler.as_mut(), Watch { finish: &AtomicBool::new(false), progress: &|_| () });
        assert_eq!(picture.counts.dropped, 0);
        let mean = picture.film.rgba().chunks_exact(4).map(Vec3::from_slice).collect();
        let variance = picture.film.replicates.variance().chunks_exact(3).map(Vec3::from_slice).collect();
        Picture { mean, variance, freedom: f64::from(picture.film.replicates.count - 1) }
    }

    /// Whether samples that are spread `evenly` over a pixel have missed a quarter of what is there, a sun's glint that `aimed`
    /// ones have found. A hundred thousand of them must agree with these.
    pub(crate) fn is_missed(&self, at: usize, side: u32, dome: &Path, [aimed, evenly]: [&Picture; 2]) -> bool {
        let (x, y) = (at as u32 % side, at as u32 / side);
        let (found, seen) = (aimed.mean[at], evenly.mean[at]);
        if (found - seen).abs().cmple(0.25 * found.max(Vec3::splat(0.1))).all() {
            return false;
        }
        let many = self.render_part([x, y, 1, 1], dome, "latlong", None, [side, 1 << 17, 2]);
        let spread = (many.variance[0] + aimed.variance[at]).map(f32::sqrt);
        println!("pixel {x}, {y}: {seen}, aimed {found}, by many {} ± {spread}", many.mean[0]);
        assert!((many.mean[0] - found).abs().cmple(5.0 * spread).all(), "pixel {x}, {y}: {found} is wrong");
        true
    }

    /// For each pixel, whether it lies inside a surface, farther than half a pixel from all outlines: 3 × 3 rays over
    /// the pixel and half of each neighbour meet one object at like depths.
    pub(crate) fn inside(&self, side: u32) -> Vec<bool> {
        let view = View::new(&self.camera, side, side);
        let pixel = |i: u32| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            let at = |k: u32| view.ray(x + (k % 3) as f32 - 0.5, y + (k / 3) as f32 - 0.5);
            let rays: Vec<_> = (0..9).map(at).collect();
            let mut hits = [Hit::MISS; 9];
            self.accel.intersect(&rays, Mask::All, Coherence::Coherent, &mut hits);
            let first = hits[4];
            let like = |h: &Hit| h.instance == first.instance && (h.t / first.t - 1.0).abs() < 0.1;
            first.is_hit() && hits.iter().all(|h| h.is_hit() && like(h))
        };
        (0..side * side).map(pixel).collect()
    }

    /// For each pixel, whether a shading normal in it faces away from the viewer, and was turned until it just faces him:
    /// 8 × 8 rays look for one.
    pub(crate) fn turned(&self, side: u32) -> Vec<bool> {
        let view = View::new(&self.camera, side, side);
        let pixel = |i: u32| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            let at = |k: u32| view.ray(x + ((k % 8) as f32 + 0.5) / 8.0, y + ((k / 8) as f32 + 0.5) / 8.0);
            let rays: Vec<_> = (0..64).map(at).collect();
            let mut hits = [Hit::MISS; 64];
            self.accel.intersect(&rays, Mask::All, Coherence::Coherent, &mut hits);
            let grazing = |(ray, hit): (&Ray, &Hit)| -self.scene.surface(ray, hit).ns.dot(ray.dir) < 1.01e-3;
            rays.iter().zip(&hits).filter(|(_, hit)| hit.is_hit()).any(grazing)
        };
        (0..side * side).map(pixel).collect()
    }

    /// For each pixel, whether its centre shows something of the scene.
    pub(crate) fn solid(&self, side: u32) -> Vec<bool> {
        let view = View::new(&self.camera, side, side);
        let rays: Vec<_> =
            (0..side * side).map(|i| view.ray((i % side) as f32 + 0.5, (i / side) as f32 + 0.5)).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        self.accel.intersect(&rays, Mask::All, Coherence::Coherent, &mut hits);
        hits.iter().map(Hit::is_hit).collect()
    }
}

/// How well two pictures of one thing agree.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Agreement {
    /// Sum over sum, and its standard error by the pixels' variances.
    pub(crate) ratio: [f64; 2],
    /// Mean of (a − b)²/(b² + 0.01), less what the noise of both brings about, and its standard error over pixels.
    pub(crate) relmse: [f64; 2],
    /// The same of a's noise and of b's.
    pub(crate) noise: [f64; 2],
    /// Pixels inside surfaces that differ by more than four standard deviations in a channel, by Welch's test, of all
    /// inside.
    pub(crate) beyond: f64,
}

/// Pixels that one of the two has not found the value of: its standard error is above a quarter of it, or of 0.1 where it
/// is dark. A sun's glint in a polished ball, met by one sample in thousands, is all of its picture's noise: where it was
/// missed, the pixel is dark *and* says that there is no noise.
pub(crate) fn unknown(a: &Picture, b: &Picture) -> Vec<bool> {
    let lost = |p: &Picture, i: usize| {
        let scale = p.mean[i] * p.mean[i] + 0.01;
        (p.variance[i] / scale).max_element() > 1.0 / 16.0
    };
    (0..a.mean.len()).map(|i| lost(a, i) || lost(b, i)).collect()
}

/// Compares the pixels of `solid`.
pub(crate) fn agreement(a: &Picture, b: &Picture, solid: &[bool], inside: &[bool]) -> Agreement {
    let (mut sums, mut errors, mut noise, mut excess) = ([0.0; 2], [0.0; 2], [0.0; 2], Vec::new());
    let (mut tested, mut beyond) = (0u32, 0u32);
    let freedom = [a.freedom, b.freedom];
    for i in (0..a.mean.len()).filter(|i| solid[*i]) {
        let [a, b, va, vb] = [a.mean[i], b.mean[i], a.variance[i], b.variance[i]].map(Vec3::as_dvec3);
        sums[0] += a.element_sum();
        sums[1] += b.element_sum();
        errors[0] += va.element_sum();
        errors[1] += vb.element_sum();
        let scale = b * b + 0.01;
        noise[0] += (va / scale).element_sum();
        noise[1] += (vb / scale).element_sum();
        excess.push((((a - b) * (a - b) - va - vb) / scale).element_sum() / 3.0);
        if inside[i] {
            tested += 1;
            let apart = |k: usize| (a - b)[k].abs() > 1e-6 && deviate((a - b)[k].abs(), [va[k], vb[k]], freedom) > 4.0;
            beyond += u32::from((0..3).any(apart));
        }
    }
    let count = excess.len() as f64;
    let relmse = excess.iter().sum::<f64>() / count;
    let spread = excess.iter().map(|e| (e - relmse).powi(2)).sum::<f64>().sqrt() / count;
    let ratio = sums[0] / sums[1];
    // Three channels of one pixel go together.
    let error = (3.0 * (errors[0] + ratio * ratio * errors[1])).sqrt() / sums[1];
    Agreement {
        ratio: [ratio, error],
        relmse: [relmse, spread],
        noise: noise.map(|n| n / (3.0 * count)),
        beyond: f64::from(beyond) / f64::from(tested),
    }
}

impl std::fmt::Display for Agreement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [[ratio, error], [relmse, spread], [a, b]] = [self.ratio, self.relmse, self.noise];
        let share = 100.0 * self.beyond;
        write!(f, "{ratio:.5} ± {error:.5}  {relmse:>9.1e} ± {spread:.1e}  {a:>7.1e}  {b:>7.1e}  {share:>6.3} %")
    }
}
