//! Lat-long domes of known make, half-float EXR with ZIP.

use anyhow::{Context, Result};
use domelight::dome::project::Grid;
use exr::prelude::*;
use glam::Vec3 as Direction;

type Radiance = [f32; 3];

/// A dome: its size and the radiance of the texel at (column, row) that is seen along a direction.
#[derive(Debug)]
pub(crate) struct Dome {
    width: u32,
    radiance: fn([u32; 2], Direction) -> Radiance,
}

/// The dome of a name.
pub(crate) fn find(name: &str) -> Option<Dome> {
    Some(match name {
        "overcast" => Dome { width: 256, radiance: overcast },
        "overcast_sun" => Dome { width: 1024, radiance: overcast_sun },
        "window" => Dome { width: 512, radiance: window },
        "studio" => Dome { width: 512, radiance: studio },
        "sunset" => Dome { width: 512, radiance: sunset },
        _ => return None,
    })
}

impl Dome {
    /// Writes the image.
    pub(crate) fn write(&self, path: &std::path::Path) -> Result<()> {
        let grid = Grid::new(self.width, self.width / 2, 0.0);
        let pixel = |Vec2(x, y): Vec2<usize>| {
            let texel = [x as u32, y as u32];
            let dir = grid.direction(x as f64 + 0.5, y as f64 + 0.5);
            let [r, g, b] = (self.radiance)(texel, dir);
            (f16::from_f32(r), f16::from_f32(g), f16::from_f32(b))
        };
        let encoding = Encoding { compression: Compression::ZIP16, ..Encoding::FAST_LOSSLESS };
        let size = (grid.width as usize, grid.height as usize);
        let layer = Layer::new(size, LayerAttributes::default(), encoding, SpecificChannels::rgb(pixel));
        // One thread writes the blocks in order: the same bytes every time.
        Image::from_layer(layer).write().non_parallel().to_file(path).with_context(|| path.display().to_string())
    }
}

fn scaled(color: Radiance, by: f32) -> Radiance {
    color.map(|c| c * by)
}

fn mixed(a: Radiance, b: Radiance, t: f32) -> Radiance {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t)
}

fn smooth(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The CIE overcast sky over grey ground.
fn overcast(_: [u32; 2], dir: Direction) -> Radiance {
    if dir.y < 0.0 { [0.10, 0.095, 0.09] } else { scaled([0.42, 0.47, 0.55], (1.0 + 2.0 * dir.y) / 3.0) }
}

/// The same, and a sun of 2 × 2 texels at 41° above +X turned 30° towards +Z.
fn overcast_sun(texel @ [x, y]: [u32; 2], dir: Direction) -> Radiance {
    if (597..599).contains(&x) && (139..141).contains(&y) {
        return [60000.0, 56000.0, 48000.0];
    }
    overcast(texel, dir)
}

/// A dark room with three windows towards +X and a dim lamp above.
fn window(_: [u32; 2], dir: Direction) -> Radiance {
    let walls = scaled([0.020, 0.018, 0.015], 1.0 + 0.5 * dir.y);
    // On the wall x = 1: windows 0.5 wide and 0.7 high, with a cross of bars.
    if dir.x > 0.2 {
        let (across, up) = (dir.z / dir.x, dir.y / dir.x);
        for centre in [-0.9, 0.0, 0.9] {
            let (a, b) = ((across - centre).abs(), (up - 0.35).abs());
            let bars = a < 0.02 || b < 0.02;
            if a < 0.25 && b < 0.35 && !bars {
                return scaled([38.0, 42.0, 50.0], 0.6 + 0.8 * (up / 0.7).clamp(0.0, 1.0));
            }
        }
    }
    let lamp = smooth(0.985, 0.995, dir.y);
    mixed(walls, [3.0, 2.4, 1.6], lamp)
}

/// Two soft boxes and a rim light about a grey studio.
fn studio(_: [u32; 2], dir: Direction) -> Radiance {
    let mut sum = scaled([0.05, 0.05, 0.055], 1.0 + dir.y.max(-0.5));
    let boxes = [
        ([0.6, 0.6, 0.55], 0.35, 0.25, [14.0, 13.5, 13.0]),
        ([-0.5, 0.35, 0.8], 0.25, 0.40, [4.0, 4.4, 5.0]),
        ([0.1, 0.5, -0.9], 0.60, 0.08, [22.0, 22.0, 22.0]),
    ];
    for (towards, wide, high, color) in boxes {
        let forward = Direction::from(towards).normalize();
        let right = Direction::Y.cross(forward).normalize();
        let up = forward.cross(right);
        let depth = dir.dot(forward);
        if depth > 0.0 {
            let edge = |x: f32, half: f32| 1.0 - smooth(half * 0.85, half, x.abs());
            let inside = edge(dir.dot(right) / depth, wide) * edge(dir.dot(up) / depth, high);
            sum = mixed(sum, color, inside);
        }
    }
    sum
}

/// A sky that glows towards a low sun (6° above +X turned −40° towards +Z) over dark ground.
fn sunset(_: [u32; 2], dir: Direction) -> Radiance {
    let (elevation, azimuth) = (6f32.to_radians(), (-40f32).to_radians());
    let sun = Direction::new(elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin());
    let cosine = dir.dot(sun).clamp(-1.0, 1.0);
    let height = dir.y.max(0.0);
    let zenith = [0.05, 0.09, 0.20];
    let horizon = mixed([0.22, 0.18, 0.22], [1.1, 0.55, 0.22], smooth(-0.6, 1.0, cosine));
    let mut sky = mixed(horizon, zenith, smooth(0.0, 0.6, height));
    let glow = (-(1.0 - cosine) * 40.0).exp();
    sky = std::array::from_fn(|i| sky[i] + glow * [6.0, 3.0, 0.9][i]);
    // A disc of 2.5° with a soft edge: a few texels.
    let disc = smooth(2.0f32.to_radians().cos(), 1.2f32.to_radians().cos(), cosine);
    sky = mixed(sky, [2400.0, 1300.0, 420.0], disc);
    mixed([0.05, 0.035, 0.03], sky, smooth(-0.02, 0.01, dir.y))
}
