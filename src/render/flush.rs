//! A queue of shadow rays is traced: what arrives, and what the sampler learns from it.

use super::Counts;
use super::tile::{GLINT, MIRRORED, SUN, Scratch, Sunny};
use crate::dome::Dome;
use crate::integrator::{World, visibility};
use crate::simd::{Kernel, dispatch};
use glam::Vec3;

/// Traces the queue and adds what arrives to its samples, each of which stands for all camera rays of its sample.
pub(super) fn flush(world: &World<'_>, s: &mut Scratch, counts: &mut Counts) {
    let queue = &mut s.queue;
    counts.shadow_rays += queue.rays.len() as u64;
    visibility::occluded(world.scene, world.accel, &queue.rays, &mut s.occluded, &mut s.visibility);
    // Layers first: what is hidden is forgotten below.
    let mut first = 0;
    for &(sample, rays) in &queue.samples {
        // What is expected of it is among the light that is known of the shaded ones.
        if sample & GLINT != 0 {
            first += rays as usize;
            continue;
        }
        let camera = camera(sample, &s.mirrored, &s.glints, &s.suns);
        let Some(aovs) = &mut s.samples[camera].aovs else { break };
        let views = s.cameras.samples[camera].views as f32;
        for i in first..first + rays as usize {
            let light = views * Dome::weight(queue.contributions.get(i).to_array());
            aovs.light[1] += light;
            aovs.light[0] += if s.occluded[i] == 0 { light } else { 0.0 };
        }
        first += rays as usize;
    }
    let contributions = queue.contributions.resize(queue.rays.len(), 0);
    let most = dispatch(Arrive { contributions, occluded: &s.occluded });
    if s.cameras.weights.is_empty() {
        counts.max_weight = counts.max_weight.max(most);
    }
    s.told.extend(queue.told());
    let [r, g, b] = queue.contributions.rows();
    let mut first = 0;
    for &(sample, rays) in &queue.samples {
        let of_sample = first..first + rays as usize;
        let arrived = [r, g, b].map(|row| row[of_sample.clone()].iter().sum::<f32>());
        let camera = camera(sample, &s.mirrored, &s.glints, &s.suns);
        if let Some(weight) = s.cameras.weights.get(camera) {
            let most = [r, g, b].into_iter().flat_map(|row| &row[of_sample.clone()]).fold(0.0, |a: f32, &b| a.max(b));
            counts.max_weight = counts.max_weight.max(most * weight);
        }
        let to = match sample & (MIRRORED | GLINT | SUN) {
            0 => &mut s.samples[camera].radiance,
            GLINT => &mut s.glints[(sample & !GLINT) as usize].1,
            SUN => &mut s.suns[(sample & !SUN) as usize].arrived,
            _ => &mut s.mirrored[(sample & !MIRRORED) as usize].1,
        };
        *to += s.cameras.samples[camera].views as f32 * Vec3::from(arrived);
        first = of_sample.end;
    }
    queue.in_order(&mut s.occluded);
    world.sampler.observe(&queue.targets, &s.occluded);
    queue.clear();
}

/// The camera ray that a queue's sample is.
fn camera(sample: u32, mirrored: &[(u32, Vec3)], glints: &[(u32, Vec3)], suns: &[Sunny]) -> usize {
    match sample & (MIRRORED | GLINT | SUN) {
        0 => sample as usize,
        GLINT => glints[(sample & !GLINT) as usize].0 as usize,
        SUN => suns[(sample & !SUN) as usize].sample as usize,
        _ => mirrored[(sample & !MIRRORED) as usize].0 as usize,
    }
}

/// Contributions treated together.
const LANES: usize = 16;

/// Takes away what does not arrive; the largest component that does.
struct Arrive<'a> {
    contributions: [&'a mut [f32]; 3],
    /// 1 or 0.
    occluded: &'a [u8],
}

impl Kernel for Arrive<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let Self { contributions, occluded } = self;
        // No branch: whether light arrives is a coin's toss.
        let arrives = |contribution: f32, mask: u32| f32::from_bits(contribution.to_bits() & mask);
        let mask = |occluded: u8| u32::from(occluded).wrapping_sub(1);
        let mut most = [0.0f32; LANES];
        let (chunks, rest) = occluded.as_chunks::<LANES>();
        let mut of_rows = contributions.map(|row| row.as_chunks_mut::<LANES>());
        for (at, occluded) in chunks.iter().enumerate() {
            let mut masks = [0; LANES];
            for i in 0..LANES {
                masks[i] = mask(occluded[i]);
            }
            for (row, _) in &mut of_rows {
                let chunk = &mut row[at];
                for i in 0..LANES {
                    let arrives = arrives(chunk[i], masks[i]);
                    chunk[i] = arrives;
                    most[i] = if arrives > most[i] { arrives } else { most[i] };
                }
            }
        }
        for (_, row) in of_rows {
            for (contribution, &occluded) in row.iter_mut().zip(rest) {
                *contribution = arrives(*contribution, mask(occluded));
                most[0] = most[0].max(*contribution);
            }
        }
        most.into_iter().fold(0.0, f32::max)
    }
}
