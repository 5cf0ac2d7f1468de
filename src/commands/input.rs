//! What is rendered, under which dome and seen from where: the options that `render` and `bench error` share.

use super::values::{finite, number, positive};
use anyhow::Result;
use domelight::scene::camera::{DEFAULT_FOV, FOV_RANGE};
use domelight::scene::{CameraChoice, LoadOptions, SceneChoice};
use glam::Vec3;
use std::path::PathBuf;

#[derive(Debug, clap::Args)]
pub(crate) struct Input {
    /// The asset: .glb or .gltf
    #[arg(value_name = "SCENE")]
    pub(crate) scene_file: PathBuf,
    /// The dome: lat-long .exr or .hdr, +Y on top, +X in the middle
    #[arg(long, value_name = "IMAGE")]
    pub(crate) dome: PathBuf,

    /// Turn the dome about +Y, degrees counter-clockwise seen from above
    #[arg(long, value_name = "DEG", default_value_t = 0.0, value_parser = finite, allow_hyphen_values = true, help_heading = "Light")]
    pub(crate) dome_rotate: f64,
    /// Multiply the dome's radiance
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = positive, allow_hyphen_values = true, help_heading = "Light")]
    pub(crate) dome_scale: f64,

    /// Which of the asset's scenes: name or index
    #[arg(long, value_name = "NAME|INDEX", help_heading = "Camera")]
    scene: Option<String>,
    /// Which of the asset's cameras: name or index (default: the first; none: a framing of the whole scene)
    #[arg(long, value_name = "NAME|INDEX", help_heading = "Camera", conflicts_with_all = ["eye", "orbit"])]
    camera: Option<String>,
    /// A camera standing here
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true, requires = "look_at", help_heading = "Camera")]
    eye: Option<Vec3>,
    /// … looking here
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true, requires = "eye", help_heading = "Camera")]
    look_at: Option<Vec3>,
    /// Vertical field of view, degrees (default: 40). Without --eye or --orbit: of a framing of the whole scene
    #[arg(long, value_name = "DEG", value_parser = fov, allow_hyphen_values = true, conflicts_with = "camera", help_heading = "Camera")]
    fov: Option<f32>,
    /// A camera around the scene: azimuth (0 sees the front) and elevation in degrees, and a distance
    #[arg(long, value_name = "AZ,EL[,DIST]", value_parser = orbit, allow_hyphen_values = true, conflicts_with = "eye", help_heading = "Camera")]
    orbit: Option<[Option<f32>; 3]>,
    /// What the orbiting or framing camera looks at (default: the middle of the scene)
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true, conflicts_with_all = ["eye", "camera"], help_heading = "Camera")]
    target: Option<Vec3>,
}

impl Input {
    pub(crate) fn load_options(&self) -> LoadOptions {
        LoadOptions { scene: self.scene.as_deref().map(|name| SceneChoice::Name(name.to_owned())) }
    }

    pub(crate) fn camera(&self) -> Result<CameraChoice> {
        let framed = self.orbit.is_some() || self.target.is_some() || self.fov.is_some();
        let fov = self.fov.unwrap_or(DEFAULT_FOV);
        Ok(match (&self.camera, self.eye, self.look_at) {
            (Some(name), ..) => CameraChoice::Named(name.clone()),
            (None, Some(eye), Some(target)) => CameraChoice::LookAt { eye, target, fov },
            _ if framed => {
                let [azimuth, elevation, distance] = self.orbit.unwrap_or([Some(35.0), Some(20.0), None]);
                let (azimuth, elevation) = (azimuth.unwrap_or(35.0), elevation.unwrap_or(20.0));
                CameraChoice::Orbit { azimuth, elevation, distance, target: self.target, fov }
            }
            _ => CameraChoice::First,
        })
    }
}

pub(crate) fn vector(text: &str) -> Result<Vec3, String> {
    match numbers(text).as_deref() {
        Ok(&[x, y, z]) => Ok(Vec3::new(x, y, z)),
        _ => Err("three finite numbers X,Y,Z are wanted".to_owned()),
    }
}

fn fov(text: &str) -> Result<f32, String> {
    // As they are written: an f32's 0.01 is not an f64's.
    let [low, high] = FOV_RANGE.map(|degrees| degrees.to_string().parse().expect("a number's own text"));
    number(low..=high)(text).map(|degrees| degrees as f32)
}

fn orbit(text: &str) -> Result<[Option<f32>; 3], String> {
    match numbers(text).as_deref() {
        Ok(&[azimuth, elevation]) => Ok([Some(azimuth), Some(elevation), None]),
        Ok(&[azimuth, elevation, distance]) if distance > 0.0 => Ok([Some(azimuth), Some(elevation), Some(distance)]),
        _ => Err("finite numbers AZ,EL or AZ,EL,DIST are wanted, DIST above 0".to_owned()),
    }
}

fn numbers(text: &str) -> Result<Vec<f32>, String> {
    let finite = |part: &str| part.trim().parse::<f32>().ok().filter(|v| v.is_finite());
    text.split(',').map(|part| finite(part).ok_or_else(|| format!("'{part}' is not a finite number"))).collect()
}

pub(crate) fn size(text: &str) -> Result<[u32; 2], String> {
    let wrong = || "WIDTHxHEIGHT is wanted, each from 1 to 65536, 268 million pixels at most".to_owned();
    let (width, height) = text.split_once(['x', '×']).ok_or_else(wrong)?;
    let side = |text: &str| text.parse().ok().filter(|side| (1..=65536).contains(side)).ok_or_else(wrong);
    let size: [u32; 2] = [side(width)?, side(height)?];
    if u64::from(size[0]) * u64::from(size[1]) > 1 << 28 { Err(wrong()) } else { Ok(size) }
}
