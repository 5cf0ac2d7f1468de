//! A render of a hard case, and what is looked at in it.

use crate::support::samplers::sampler;
use domelight::accel;
use domelight::dome::Dome;
use domelight::film::{Aov, Filter};
use domelight::integrator::INTEGRATORS;
use domelight::registry::resolve;
use domelight::render::{Background, Picture, Render, Settings, Watch};
use domelight::scene::{Camera, Projection, Scene, View};
use glam::{Affine3A, DVec3, Mat3A, Vec3};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The structure that renders use when nothing else is said, and the one in Rust.
pub(crate) const STRUCTURES: [&str; 2] = [accel::ACCELS[0].name, "bvh"];

/// How a hard case is rendered.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shot {
    pub(crate) sampler: &'static str,
    pub(crate) structure: &'static str,
    pub(crate) size: [u32; 2],
    pub(crate) crop: Option<[u32; 4]>,
    pub(crate) spp: u32,
    pub(crate) rays: u32,
    pub(crate) seed: u32,
    pub(crate) background: Background,
}

impl Default for Shot {
    fn default() -> Self {
        Self {
            sampler: "tessellated",
            structure: STRUCTURES[0],
            size: [8, 8],
            crop: None,
            spp: 16,
            rays: 16,
            seed: 0,
            background: Background::Black,
        }
    }
}

impl Shot {
    /// The render; no sample is ever dropped, and no pixel is anything but a number.
    pub(crate) fn take(&self, scene: &Arc<Scene>, dome: &Arc<Dome>, camera: &Camera) -> Picture {
        let picture = self.take_whatever_comes(scene, dome, camera);
        assert_eq!(picture.counts.dropped, 0, "dropped samples: {:?}", picture.counts);
        assert!(picture.film.rgba().iter().all(|v| v.is_finite()));
        picture
    }

    /// The render, dropped samples and all.
    pub(crate) fn take_whatever_comes(&self, scene: &Arc<Scene>, dome: &Arc<Dome>, camera: &Camera) -> Picture {
        let accel = accel::build(self.structure, scene, 2).unwrap();
        let (plugin, params) = resolve("integrator", INTEGRATORS, "direct").unwrap();
        let integrator = (plugin.make)(&params).unwrap();
        let [width, height] = self.size;
        let settings = Settings {
            size: self.size,
            crop: self.crop.unwrap_or([0, 0, width, height]),
            spp: self.spp,
            rays: self.rays,
            camera_rays: None,
            seed: self.seed,
            tile: 32,
            filter: Filter::Box,
            background: self.background,
            aovs: true,
            variance: false,
            time: None,
        };
        let render = Render {
            scene,
            accel: accel.as_ref(),
            dome,
            integrator: integrator.as_ref(),
            view: &View::new(camera, width, height),
            settings,
        };
        let mut sampler = sampler(self.sampler, dome, self.rays);
        render.run(sampler.as_mut(), Watch { finish: &AtomicBool::new(false), progress: &|_| () })
    }

    /// The mean of all pixels and its standard error, a channel each.
    pub(crate) fn mean(&self, scene: &Arc<Scene>, dome: &Arc<Dome>, camera: &Camera) -> (DVec3, DVec3) {
        mean(&colors(&self.take(scene, dome, camera)))
    }
}

/// A picture's pixels.
pub(crate) fn colors(picture: &Picture) -> Vec<DVec3> {
    picture.film.rgba().chunks_exact(4).map(|p| Vec3::new(p[0], p[1], p[2]).as_dvec3()).collect()
}

/// Mean and standard error.
pub(crate) fn mean(values: &[DVec3]) -> (DVec3, DVec3) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<DVec3>() / count;
    // Divided before it is squared: values may lie near the ends of what a float can hold.
    let scale = mean.max_element().max(f64::MIN_POSITIVE);
    let variance = values.iter().map(|v| ((v - mean) / scale).powf(2.0)).sum::<DVec3>() / (count - 1.0).max(1.0);
    (mean, (variance / count).map(f64::sqrt) * scale)
}

/// Pixels that show geometry, and those of them in which some shadow ray was stopped.
pub(crate) fn shadowed(picture: &Picture) -> [usize; 2] {
    let seen = picture.film.layer(Aov::Depth).into_iter().zip(picture.film.layer(Aov::Visibility));
    let seen: Vec<f32> = seen.filter(|(depth, _)| *depth > 0.0).map(|(_, visibility)| visibility).collect();
    [seen.len(), seen.iter().filter(|v| **v < 1.0).count()]
}

/// A camera at `eye` that looks along `forward`; vertical field of view in degrees.
pub(crate) fn pinhole(eye: Vec3, forward: Vec3, fov: f32) -> Camera {
    let back = -forward.normalize();
    let (right, up) = back.any_orthonormal_pair();
    let transform =
        Affine3A { matrix3: Mat3A::from_cols(right.into(), up.into(), back.into()), translation: eye.into() };
    Camera { name: "pinhole".into(), transform, projection: Projection::Perspective { yfov: fov.to_radians() } }
}

/// A camera of parallel rays along `forward` that shows `half` metres up and down of `center`.
pub(crate) fn parallel(center: Vec3, forward: Vec3, distance: f32, half: f32) -> Camera {
    let mut camera = pinhole(center - forward.normalize() * distance, forward, 40.0);
    camera.projection = Projection::Orthographic { ymag: half };
    camera
}
