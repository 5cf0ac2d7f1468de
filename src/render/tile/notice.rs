//! What a chunk's samples tell of how further ones are best spread ([`Views`]).

use super::super::cameras::CameraSample;
use super::super::views::{Seen, Views};
use super::{Scratch, Sunny};
use crate::dome::Dome;
use glam::Vec3;

/// Shows `seen` what was expected, and what has become of it.
pub(super) fn notice(seen: &Views, s: &mut Scratch) {
    let light = |radiance: Vec3| Dome::weight(radiance.to_array());
    let mut first = 0;
    let mut mirrored = s.mirrored.iter().peekable();
    let mut glints = s.glints.iter().peekable();
    let mut suns = s.suns.iter().peekable();
    let mut told = s.told.iter().peekable();
    let mut notes = seen.notes();
    for &expected in &s.expected {
        let CameraSample { pixel, views, rays, deals: dealt, noted, spotted, .. } = s.cameras.samples[first];
        let of_sample = &s.samples[first..first + views as usize];
        s.lights.clear();
        s.lights.extend(of_sample.iter().map(|sample| light(sample.radiance)));
        // The first one holds what its rays have brought once for each.
        let reflected = mirrored.next_if(|mirrored| mirrored.0 as usize == first);
        let mirrors = reflected.is_some();
        let mut shown = reflected.map_or(expected, |reflected| expected + reflected.1);
        let beside = (s.lights[0] - light(expected)) / views as f32;
        let (of, mut noise, mut sunny) = (first as u32..first as u32 + views, 0.0, 0.0);
        while let Some(&Sunny { sample, rays, all, arrived }) = suns.next_if(|sun| of.contains(&sun.sample)) {
            if sample as usize == first {
                shown += arrived;
            }
            s.lights[sample as usize - first] += light(arrived);
            sunny += 1.0 / views as f32;
            // Each ray carries about the same.
            noise += light(arrived) * (all - light(arrived)) / (rays - 1).max(1) as f32;
        }
        let known = light(shown) + beside;
        s.lights[0] = light(shown);
        while let Some(&(sample, glint)) = glints.next_if(|glint| of.contains(&glint.0)) {
            s.lights[sample as usize - first] += light(glint);
        }
        let (traced, told) = (s.hits[first].is_hit(), told.next_if(|told| told.sample as usize == first));
        // Where nothing is traced nothing is noisy.
        let (noise_of_rays, saved) = told.map_or((Some(0.0), 0.0), |told| (told.noise, told.saved));
        let told = noise_of_rays.filter(|_| noted).map(|noise| [noise, saved]);
        // Beside samples that are aimed others weigh less the brighter they are: such pixels are no measure.
        if !spotted {
            let noise = noise / views as f32;
            notes.take_in(pixel, Seen { expected: &s.lights, known, noise, sunny, rays, traced, mirrors, dealt, told });
        }
        first += views as usize;
    }
}
