//! Renders and what they cost: process CPU time from the sampler's preparation to the last ray.

use anyhow::Result;
use domelight::accel::Accel;
use domelight::dome::Dome;
use domelight::film::Filter;
use domelight::integrator::Integrator;
use domelight::registry::resolve;
use domelight::render::{Background, Picture, Render, Settings, Watch};
use domelight::sampler::{SAMPLERS, Setup};
use domelight::scene::{Scene, View};
use glam::Vec3;
use rustix::time::{ClockId, clock_gettime};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Everything that is loaded once.
#[derive(Debug)]
pub(super) struct Bench {
    pub(super) scene: Arc<Scene>,
    pub(super) dome: Arc<Dome>,
    pub(super) accel: Box<dyn Accel>,
    pub(super) integrator: Box<dyn Integrator>,
    pub(super) view: View,
    pub(super) size: [u32; 2],
    pub(super) background: Background,
}

/// One render.
#[derive(Debug)]
pub(super) struct Shot {
    pub(super) pixels: Vec<Vec3>,
    /// CPU seconds, preparation included.
    pub(super) cpu_s: f64,
    /// CPU seconds of the preparation.
    pub(super) prepare_s: f64,
    pub(super) wall_s: f64,
    pub(super) camera_rays: u64,
    pub(super) shadow_rays: u64,
}

impl Bench {
    pub(super) fn shoot(&self, spec: &str, [spp, rays]: [u32; 2], seed: u32) -> Result<Shot> {
        let (plugin, params) = resolve("sampler", SAMPLERS, spec)?;
        let setup = Setup { size: self.size, gloss: self.scene.needs.gloss, rays, spp };
        let (wall, begun) = (Instant::now(), cpu_s());
        let mut sampler = (plugin.make)(&self.dome, &params, &setup)?;
        let prepared = cpu_s();
        let [width, height] = self.size;
        let settings = Settings {
            size: self.size,
            crop: [0, 0, width, height],
            spp,
            rays,
            camera_rays: None,
            seed,
            tile: 32,
            filter: Filter::Box,
            background: self.background,
            aovs: false,
            variance: false,
            time: None,
        };
        let render = Render {
            scene: &self.scene,
            accel: self.accel.as_ref(),
            dome: &self.dome,
            integrator: self.integrator.as_ref(),
            view: &self.view,
            settings,
        };
        let watch = Watch { finish: &AtomicBool::new(false), progress: &|_| () };
        let picture = render.run(sampler.as_mut(), watch);
        Ok(Shot {
            cpu_s: cpu_s() - begun,
            prepare_s: prepared - begun,
            wall_s: wall.elapsed().as_secs_f64(),
            camera_rays: picture.counts.camera_rays,
            shadow_rays: picture.counts.shadow_rays,
            pixels: pixels(&picture),
        })
    }
}

fn pixels(picture: &Picture) -> Vec<Vec3> {
    picture.film.rgba().chunks_exact(4).map(|p| Vec3::new(p[0], p[1], p[2])).collect()
}

/// CPU seconds of all threads of this process so far.
fn cpu_s() -> f64 {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    now.tv_sec as f64 + now.tv_nsec as f64 * 1e-9
}
