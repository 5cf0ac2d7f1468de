//! A film cut up, so that threads add to parts of it at once.

use super::{Film, Pixel, Sample};
use glam::Vec3;

/// A rectangle of a film's pixels that samples are added to.
#[derive(Debug)]
pub struct Part<'a> {
    /// First column and row, in the full image.
    offset: [u32; 2],
    /// From the top.
    lines: Vec<Line<'a>>,
}

#[derive(Debug)]
struct Line<'a> {
    pixels: &'a mut [Pixel],
    /// As in [`Film`]: empty unless asked for.
    aovs: &'a mut [[f64; 12]],
}

impl Film {
    /// The film in parts: column, row, width and height of each in the full image. They cover the film in rows of parts of
    /// one height, from the left.
    pub fn parts(&mut self, windows: &[[u32; 4]]) -> Vec<Part<'_>> {
        let part = |&[x, y, _, height]: &[u32; 4]| Part { offset: [x, y], lines: Vec::with_capacity(height as usize) };
        let mut parts: Vec<Part<'_>> = windows.iter().map(part).collect();
        let (mut pixels, mut aovs) = (&mut self.pixels[..], &mut self.aovs[..]);
        let mut first = 0;
        for row in windows.chunk_by(|a, b| a[1] == b[1]) {
            for _ in 0..row[0][3] {
                for (part, window) in parts[first..].iter_mut().zip(row) {
                    let width = window[2] as usize;
                    let line = Line {
                        pixels: pixels.split_off_mut(..width).expect("the parts cover the film"),
                        aovs: aovs.split_off_mut(..width.min(aovs.len())).expect("as many as pixels, or none"),
                    };
                    part.lines.push(line);
                }
            }
            first += row.len();
        }
        parts
    }
}

impl Part<'_> {
    /// Adds light to a pixel beside that of its samples.
    pub fn add_light(&mut self, [x, y]: [u32; 2], radiance: Vec3) {
        let line = &mut self.lines[(y - self.offset[1]) as usize];
        let pixel = &mut line.pixels[(x - self.offset[0]) as usize];
        for (sum, value) in pixel.sum.iter_mut().zip(radiance.to_array()) {
            *sum += f64::from(value);
        }
    }

    /// Adds a sample of some weight to a pixel, told by its place in the full image. The caller has dropped non-finite ones.
    pub fn add(&mut self, [x, y]: [u32; 2], sample: &Sample, weight: f32) {
        let Line { pixels, aovs } = &mut self.lines[(y - self.offset[1]) as usize];
        let column = (x - self.offset[0]) as usize;
        let weight = f64::from(weight);
        let pixel = &mut pixels[column];
        let values = [sample.radiance.x, sample.radiance.y, sample.radiance.z, sample.alpha];
        for (sum, value) in pixel.sum.iter_mut().zip(values) {
            *sum += weight * f64::from(value);
        }
        pixel.samples += weight;
        if let (Some(sums), Some(aovs)) = (aovs.get_mut(column), &sample.aovs) {
            let [a, n, p] = [aovs.albedo, aovs.normal, aovs.position].map(|v| v.to_array());
            let values =
                [a[0], a[1], a[2], n[0], n[1], n[2], aovs.depth, p[0], p[1], p[2], aovs.light[0], aovs.light[1]];
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += weight * f64::from(value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::film::{Aov, AovSample};
    use glam::Vec3;

    #[test]
    fn parts_add_to_the_film_where_they_lie() {
        for aovs in [false, true] {
            let mut film = Film::new([3, 5], [5, 3], aovs);
            let windows = [[3, 5, 2, 2], [5, 5, 3, 2], [3, 7, 2, 1], [5, 7, 3, 1]];
            for (part, [x, y, width, height]) in film.parts(&windows).iter_mut().zip(windows) {
                for (x, y) in (x..x + width).flat_map(|x| (y..y + height).map(move |y| (x, y))) {
                    let depth = (10 * x + y) as f32;
                    let layers = aovs.then_some(AovSample { depth, ..AovSample::default() });
                    part.add([x, y], &Sample { radiance: Vec3::splat(depth), alpha: 1.0, aovs: layers }, 1.0);
                }
            }
            let expected: Vec<f32> = (5..8).flat_map(|y| (3..8).map(move |x| (10 * x + y) as f32)).collect();
            let red: Vec<f32> = film.rgba().into_iter().step_by(4).collect();
            assert_eq!(red, expected);
            assert_eq!(film.layer(Aov::Depth), if aovs { expected } else { Vec::new() });
        }
    }
}
