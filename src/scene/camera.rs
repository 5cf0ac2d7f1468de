//! Which camera, and the rays it sends: pixel centres lie at halves, x runs right, y down.

use super::{Camera, Projection, Scene};
use crate::accel::Ray;
use crate::error::{Error, Result};
use glam::{Affine3A, Mat3A, Vec3, Vec3A};

/// The vertical field of view of a camera nobody described, degrees.
pub const DEFAULT_FOV: f32 = 40.0;
/// The vertical fields of view that can be asked for, degrees.
pub const FOV_RANGE: [f32; 2] = [0.01, 179.0];
/// What is left free around a framed scene.
const MARGIN: f32 = 1.05;

/// Which camera is meant.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum CameraChoice {
    /// The asset's first camera, [`CameraChoice::framed`] when it has none.
    #[default]
    First,
    /// The asset's camera of this name, or of this index.
    Named(String),
    /// A camera at `eye` that looks at `target`, +Y up.
    LookAt {
        /// Where it stands.
        eye: Vec3,
        /// What it looks at.
        target: Vec3,
        /// Vertical field of view, degrees.
        fov: f32,
    },
    /// A camera on a sphere about the scene.
    Orbit {
        /// Degrees about +Y: 0 looks from +Z (a model's front), 90 from +X.
        azimuth: f32,
        /// Degrees above the horizon.
        elevation: f32,
        /// Distance to the target; `None`: the whole scene is in view.
        distance: Option<f32>,
        /// What it looks at; `None`: the middle of the scene.
        target: Option<Vec3>,
        /// Vertical field of view, degrees.
        fov: f32,
    },
}

impl CameraChoice {
    /// The whole scene in view, from three quarters in front and a little above.
    pub fn framed() -> Self {
        Self::Orbit { azimuth: 35.0, elevation: 20.0, distance: None, target: None, fov: DEFAULT_FOV }
    }

    /// The camera for a picture of this aspect ratio (width over height).
    ///
    /// # Errors
    /// [`Error::Option`] for a name the asset does not have and for values out of range.
    pub fn resolve(&self, scene: &Scene, aspect: f32) -> Result<Camera> {
        match self {
            Self::First => scene.cameras.first().cloned().map_or_else(|| Self::framed().resolve(scene, aspect), Ok),
            Self::Named(name) => named(scene, name),
            Self::LookAt { eye, target, fov } => {
                let yfov = radians(*fov)?;
                if !(eye.is_finite() && target.is_finite()) || eye == target {
                    return Err(Error::Option(format!(
                        "the camera at {eye} can't look at {target}; give two different points"
                    )));
                }
                Ok(look_at(*eye, *target, yfov))
            }
            Self::Orbit { azimuth, elevation, distance, target, fov } => {
                let yfov = radians(*fov)?;
                let finite = azimuth.is_finite() && elevation.is_finite() && target.is_none_or(|t| t.is_finite());
                if !finite || distance.is_some_and(|d| !(d > 0.0 && d.is_finite())) {
                    return Err(Error::Option("an orbit takes finite angles and a distance above 0".into()));
                }
                let ((sin, cos), (up, ring)) = (azimuth.to_radians().sin_cos(), elevation.to_radians().sin_cos());
                let towards_eye = Vec3::new(ring * sin, up, ring * cos);
                let [low, high] = scene.bounds;
                let target = target.unwrap_or(0.5 * low + 0.5 * high);
                let distance = distance.unwrap_or_else(|| framing_distance(scene, target, towards_eye, yfov, aspect));
                let mut camera = look_at(target + towards_eye, target, yfov);
                // From the direction, not from two nearly equal points: exact for far targets and small distances.
                camera.transform.matrix3 = frame(towards_eye);
                camera.transform.translation = Vec3A::from(target + towards_eye * distance);
                camera.name = "orbit".into();
                Ok(camera)
            }
        }
    }
}

fn named(scene: &Scene, name: &str) -> Result<Camera> {
    let by_name = scene.cameras.iter().find(|c| c.name == name);
    let by_index = || scene.cameras.get(name.parse::<usize>().ok()?);
    by_name.or_else(by_index).cloned().ok_or_else(|| {
        let known: Vec<_> = scene.cameras.iter().enumerate().map(|(i, c)| format!("{i} ({})", c.name)).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        Error::Option(format!("the asset has no camera '{name}'; known: {known}"))
    })
}

fn radians(fov: f32) -> Result<f32> {
    let [least, most] = FOV_RANGE;
    if fov >= least && fov <= most {
        return Ok(fov.to_radians());
    }
    Err(Error::Option(format!("a field of view of {fov}° is not in {least}..{most} (vertical degrees)")))
}

fn look_at(eye: Vec3, target: Vec3, yfov: f32) -> Camera {
    // In f64: eye and target may lie far out and close together.
    let back = (eye.as_dvec3() - target.as_dvec3()).normalize().as_vec3();
    let transform = Affine3A { matrix3: frame(back), translation: Vec3A::from(eye) };
    Camera { name: "look-at".into(), transform, projection: Projection::Perspective { yfov } }
}

/// Right, up and back of a camera whose back is given. Looking along +Y or −Y, the picture's top is −Z or +Z: what a
/// camera tilted there from the front would show.
fn frame(back: Vec3) -> Mat3A {
    let back = back.normalize_or(Vec3::Z);
    let right = Vec3::Y.cross(back);
    let right = if right.length_squared() > 1e-10 { right.normalize() } else { Vec3::X };
    Mat3A::from_cols(right.into(), back.cross(right).into(), back.into())
}

/// The distance from `target` along `back` from which all corners of the scene's bounds are in view.
fn framing_distance(scene: &Scene, target: Vec3, back: Vec3, yfov: f32, aspect: f32) -> f32 {
    let axes = frame(back);
    let tan_y = (0.5 * yfov).tan();
    let tan_x = tan_y * aspect.max(1e-6);
    let [low, high] = scene.bounds;
    let mut distance = 0.0f32;
    for corner in 0..8 {
        let pick = |axis: usize| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] };
        let p = axes.transpose() * Vec3A::from(Vec3::new(pick(0), pick(1), pick(2)) - target);
        distance = distance.max(p.z + (p.x.abs() / tan_x).max(p.y.abs() / tan_y) * MARGIN);
    }
    // A scene that is a point (or nothing) can be seen from anywhere.
    if distance > 0.0 && distance.is_finite() { distance } else { 1.0 }
}

/// A camera in front of a picture.
#[derive(Debug, Clone, Copy)]
pub struct View {
    origin: Vec3,
    /// The picture's left upper corner, in directions or (orthographic) in positions.
    corner: Vec3,
    /// One pixel to the right and one down.
    right: Vec3,
    down: Vec3,
    /// The direction of parallel rays; `None` for a pinhole.
    parallel: Option<Vec3>,
    /// World size of a pixel at distance 1 (perspective) or anywhere.
    pixel: f32,
}

impl View {
    /// `camera` taking a picture of `width` × `height` square pixels.
    pub fn new(camera: &Camera, width: u32, height: u32) -> Self {
        let (width, height) = (width.max(1) as f32, height.max(1) as f32);
        let m = &camera.transform.matrix3;
        let (right, up, forward) = (Vec3::from(m.x_axis), Vec3::from(m.y_axis), -Vec3::from(m.z_axis));
        let origin = Vec3::from(camera.transform.translation);
        let (half, parallel) = match camera.projection {
            Projection::Perspective { yfov } => ((0.5 * yfov).tan(), None),
            Projection::Orthographic { ymag } => (ymag, Some(forward)),
        };
        let pixel = 2.0 * half / height;
        let corner = up * half - right * (half * width / height);
        let corner = if parallel.is_some() { corner } else { corner + forward };
        Self { origin, corner, right: right * pixel, down: -up * pixel, parallel, pixel }
    }

    /// The ray through the point (`x`, `y`) of the picture, in pixels from the left upper corner; its direction has unit
    /// length.
    #[inline]
    pub fn ray(&self, x: f32, y: f32) -> Ray {
        let point = self.corner + self.right * x + self.down * y;
        match self.parallel {
            None => Ray::new(self.origin, point.normalize()),
            Some(dir) => Ray::new(self.origin + point, dir),
        }
    }

    /// The world size of a pixel at a distance.
    #[inline]
    pub fn footprint(&self, distance: f32) -> f32 {
        if self.parallel.is_some() { self.pixel } else { self.pixel * distance }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(low: Vec3, high: Vec3) -> Scene {
        Scene { bounds: [low, high], ..Scene::default() }
    }

    #[test]
    fn x_runs_right_y_down_and_the_centre_looks_ahead() {
        let choice = CameraChoice::LookAt { eye: Vec3::Z * 5.0, target: Vec3::ZERO, fov: 90.0 };
        let view = View::new(&choice.resolve(&Scene::default(), 2.0).unwrap(), 200, 100);
        assert!((view.ray(100.0, 50.0).dir + Vec3::Z).length() < 1e-6);
        let corner = view.ray(0.0, 0.0).dir;
        assert!((corner - Vec3::new(-2.0, 1.0, -1.0).normalize()).length() < 1e-6, "{corner}");
        assert!((view.footprint(3.0) - 0.06).abs() < 1e-6);
    }

    #[test]
    fn framing_shows_every_corner_for_any_shape() {
        for (low, high) in [
            (Vec3::splat(-1.0), Vec3::ONE),
            (Vec3::new(1e6, 0.0, 0.0), Vec3::new(1e6 + 10.0, 1.0, 100.0)),
            (Vec3::ZERO, Vec3::new(1e-4, 2e-4, 0.0)),
        ] {
            let scene = scene(low, high);
            for (aspect, fov, azimuth, elevation) in
                [(1.0, 40.0, 35.0, 20.0), (3.0, 10.0, 0.0, 90.0), (0.2, 120.0, 200.0, -90.0), (1.5, 1.0, 90.0, 5.0)]
            {
                let choice = CameraChoice::Orbit { azimuth, elevation, distance: None, target: None, fov };
                let camera = choice.resolve(&scene, aspect).unwrap();
                let tan = (0.5 * fov.to_radians()).tan();
                for i in 0..8 {
                    let p = Vec3::new([low, high][i & 1].x, [low, high][i >> 1 & 1].y, [low, high][i >> 2].z);
                    let p = camera.transform.matrix3.transpose() * (Vec3A::from(p) - camera.transform.translation);
                    let inside = p.z < 0.0 && p.y.abs() <= -p.z * tan && p.x.abs() <= -p.z * tan * aspect;
                    assert!(inside, "{low} {high} {aspect} {fov} {azimuth}: {p}");
                }
            }
        }
    }

    #[test]
    fn fields_of_view_out_of_range_and_unknown_names_are_refused() {
        let scene = Scene::default();
        for fov in [0.0, 180.0, -5.0, f32::NAN] {
            let choice = CameraChoice::LookAt { eye: Vec3::Z, target: Vec3::ZERO, fov };
            assert!(choice.resolve(&scene, 1.0).unwrap_err().to_string().contains("0.01..179"), "{fov}");
        }
        let error = CameraChoice::Named("main".into()).resolve(&scene, 1.0).unwrap_err().to_string();
        assert!(error.contains("'main'") && error.contains("none"), "{error}");
        assert!(CameraChoice::First.resolve(&scene, 1.0).unwrap().transform.is_finite());
    }

    #[test]
    fn looking_along_up_has_a_frame() {
        for dir in [Vec3::Y, -Vec3::Y] {
            let choice = CameraChoice::LookAt { eye: dir, target: Vec3::ZERO, fov: 40.0 };
            let m = choice.resolve(&Scene::default(), 1.0).unwrap().transform.matrix3;
            assert!((m.determinant() - 1.0).abs() < 1e-6, "{m}");
        }
    }

    #[test]
    fn parallel_rays_are_parallel() {
        let transform = Affine3A::IDENTITY;
        let camera = Camera { name: String::new(), transform, projection: Projection::Orthographic { ymag: 2.0 } };
        let view = View::new(&camera, 40, 20);
        let ray = view.ray(40.0, 0.0);
        assert_eq!((ray.origin, ray.dir), (Vec3::new(4.0, 2.0, 0.0), -Vec3::Z));
        assert_eq!(view.footprint(100.0), 0.2);
    }
}
