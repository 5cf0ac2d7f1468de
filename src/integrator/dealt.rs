//! A point's directions dealt out to all that its sample's camera rays met.
//!
//! Where visibility changes inside a pixel, as at a sun's hard shadow, all rays from one place find out the same. From several
//! places they find out more, and are no more rays. One drawn for the first camera ray's point may begin at another one's if
//! the sampler would have drawn it there with the same density ([`crate::sampler::DomeSampler::expected`] says where). Of two
//! such places either is as likely to be the first: what a ray brings in the mean over the pixel stays what it is, whether or
//! not it moves.

use super::lambert::TRACED;
use super::{Lambert, Post, Queue};
use crate::dome::Dome;
use crate::sampler::Draws;
use glam::Vec3;
use std::mem;

/// Directions after which a deal begins anew.
pub(super) const HANDS: usize = 16;

/// Who has which direction.
#[derive(Debug, Default)]
pub struct Dealt {
    /// Where rays begin.
    pub(super) origin: [Vec3; HANDS],
    /// Whether all that differs is where rays begin: the rows below are not filled in.
    pub(super) is_flat: bool,
    /// As in [`Lambert`], a row a component.
    pub(super) ng: [[f32; HANDS]; 3],
    pub(super) ns: [[f32; HANDS]; 3],
    pub(super) k: [[f32; HANDS]; 3],
    /// Whose directions they are, by camera ray.
    view: [u8; HANDS],
}

/// What a deal comes to, in the mean over the directions.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hand {
    /// Reflectance/π.
    pub(super) k: Vec3,
    /// By how much more the first point's diffuse term is expected to be.
    pub(super) beside: Vec3,
}

impl Dealt {
    /// Deals `count` directions out among `posts`, of which `own` is the first: in turn, or shuffled by a word.
    pub(super) fn deal(&mut self, own: &Post, posts: &[Option<Post>], count: usize, shuffle: Option<u32>) -> Hand {
        let views = posts.len().min(HANDS);
        let first = &own.lambert;
        self.origin = [first.origin; HANDS];
        self.view = [0; HANDS];
        self.is_flat = posts[1..views].iter().flatten().all(|post| post.lambert.is_like(first));
        if !self.is_flat {
            let splat = |v: Vec3| v.to_array().map(|x| [x; HANDS]);
            (self.ng, self.ns, self.k) = (splat(first.ng), splat(first.ns), splat(first.k));
        }
        let mut sum = Hand { k: first.k * count as f32, beside: Vec3::ZERO };
        let hands = count.min(HANDS);
        for (view, post) in posts[..views].iter().enumerate().skip(1) {
            let Some(post) = post else { continue };
            let mut directions = 0;
            let mut take = |hand: usize| {
                self.give(hand, view, &post.lambert);
                directions += (count - hand).div_ceil(HANDS);
            };
            match shuffle {
                Some(word) => {
                    (0..hands).filter(|&hand| shuffled(hand, word) * views / HANDS == view).for_each(&mut take)
                }
                None => (view..hands).step_by(views).for_each(&mut take),
            }
            sum.k += directions as f32 * (post.lambert.k - first.k);
            sum.beside += directions as f32 * (own.expected - post.expected);
        }
        Hand { k: sum.k / count as f32, beside: sum.beside / count as f32 }
    }

    #[inline]
    fn give(&mut self, hand: usize, view: usize, &Lambert { origin, ng, ns, k }: &Lambert) {
        self.origin[hand] = origin;
        self.view[hand] = view as u8;
        if !self.is_flat {
            for (rows, v) in [(&mut self.ng, ng), (&mut self.ns, ns), (&mut self.k, k)] {
                rows.iter_mut().zip(v.to_array()).for_each(|(row, x)| row[hand] = x);
            }
        }
    }
}

/// A place among the hands, another for each.
fn shuffled(hand: usize, word: u32) -> usize {
    ((word | 1).wrapping_mul(hand as u32).wrapping_add(word >> 8) % HANDS as u32) as usize
}

/// A sample whose rays are noted.
#[derive(Debug, Clone, Copy)]
pub struct Note {
    /// The camera sample.
    sample: u32,
    /// Its shadow rays: the first, and how many.
    first: u32,
    count: u32,
    /// How many of these, the first ones, were dealt out, shuffled, and to how many camera rays.
    dealt: u32,
    views: u32,
}

/// What a noted sample's rays tell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Told {
    /// The camera sample.
    pub sample: u32,
    /// The variance, the luminance's, of what its rays bring, as far as it falls with their number: what two that are drawn one
    /// after the other, from much the same of the dome, differ by. Of a single one nothing is known.
    pub noise: Option<f32>,
    /// If they were dealt out: the part of the variance that n camera rays divide by n, for the light differs from place to place.
    pub saved: f32,
}

impl Queue {
    /// Says what the control variate takes each direction for that is traced, all of them drawn for the point itself.
    pub(super) fn note(&mut self, draws: &Draws, k: Vec3) {
        let count = draws.dir.len();
        for i in (0..count).filter(|&i| draws.fate[i] == TRACED) {
            self.note_one(draws, count, i, k, 0);
        }
    }

    /// The same of directions that were dealt out.
    pub(super) fn note_dealt(&mut self, draws: &Draws, own: &Post, posts: &[Option<Post>]) {
        let (count, before) = (draws.dir.len(), self.residuals.len());
        for i in (0..count).filter(|&i| draws.fate[i] == TRACED) {
            let view = self.dealt.view[i % HANDS];
            let post = posts[usize::from(view)].as_ref().filter(|_| view > 0).unwrap_or(own);
            self.note_one(draws, count, i, post.lambert.k, view);
        }
        self.dealt_out = [(self.residuals.len() - before) as u32, posts.len() as u32];
    }

    fn note_one(&mut self, draws: &Draws, count: usize, i: usize, reflected: Vec3, view: u8) {
        let control = draws.control.get(i).map_or(0.0, |control| control / (draws.pdf[i] * count as f32));
        self.residuals.push((Dome::weight((reflected * draws.radiance.get(i) * control).to_array()), view));
    }

    /// Notes the sample whose rays were queued from `first` on, when there were so many residuals. Those of which nothing was
    /// said have no control variate.
    pub fn end_note(&mut self, [first, residuals]: [usize; 2]) {
        let count = self.rays.len() - first;
        self.residuals.resize(residuals + count, (0.0, 0));
        let [dealt, views] = mem::take(&mut self.dealt_out);
        self.noted.push(Note { sample: self.sample, first: first as u32, count: count as u32, dealt, views });
    }

    /// When only what arrives is left of the contributions: what the rays of each noted sample tell. What n camera rays divide by
    /// n is so much larger the products of rays' residuals (by how much more arrives than the control variate takes it for) are
    /// where two begin at the same place.
    pub fn told(&self) -> impl Iterator<Item = Told> {
        let mut residuals = self.residuals.iter();
        self.noted.iter().map(move |&Note { sample, first, count, dealt, views }| {
            let (mut of_view, mut rays_of_view, mut squares) = ([0.0f32; HANDS], [0.0f32; HANDS], 0.0);
            let (mut noise, mut before) = (0.0, 0.0);
            for (i, (ray, &(control, view))) in (first..first + count).zip(&mut residuals).enumerate() {
                let residual = Dome::weight(self.contributions.get(ray as usize).to_array()) - control;
                noise += if i % 2 == 1 { (residual - before) * (residual - before) } else { 0.0 };
                before = residual;
                if i < dealt as usize {
                    of_view[usize::from(view)] += residual;
                    rays_of_view[usize::from(view)] += 1.0;
                    squares += residual * residual;
                }
            }
            let sum: f32 = of_view.iter().sum();
            let of_views: f32 = of_view.iter().map(|sum| sum * sum).sum();
            // Ordered pairs of rays from the same place and from two, and the sums of their products.
            let pairs: f32 = rays_of_view.iter().map(|rays| rays * (rays - 1.0)).sum();
            let others = (dealt * dealt.saturating_sub(1)) as f32 - pairs;
            let (same, different) = (of_views - squares, sum * sum - of_views);
            let saved = (same * (others / pairs) - different) / (1.0 - 1.0 / views as f32);
            // The last of an odd number has no partner.
            let noise = (count > 1).then(|| noise * (count as f32 / (count & !1) as f32));
            Told { sample, noise, saved: if pairs > 0.0 && others > 0.0 { saved } else { 0.0 } }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accel::Ray;
    use crate::random;

    #[test]
    fn shuffled_hands_are_all_different() {
        for word in 0..1000 {
            let mut places: Vec<_> = (0..HANDS).map(|hand| shuffled(hand, random::mix(word))).collect();
            places.sort_unstable();
            assert!(places.into_iter().eq(0..HANDS));
        }
    }

    /// Sixteen rays from four places where light is seen by half of all places, ray by ray by chance or by all rays of a
    /// place alike: dealing saves the latter alone, all of the variance between places.
    #[test]
    fn what_differs_between_places_is_saved() {
        for (alike, expected) in [(true, 0.25), (false, 0.0)] {
            let (mut sum, samples) = (0.0, 20_000);
            for sample in 0..samples {
                let mut queue = Queue::default();
                for i in 0..16 {
                    let view = shuffled(i, random::hash(&[sample])) * 4 / HANDS;
                    let of = if alike { view } else { 100 + i };
                    let arrives = random::hash(&[sample, of as u32, 7]) >> 31;
                    queue.push(Ray::new(Vec3::ZERO, Vec3::X), Vec3::splat(arrives as f32 / 16.0));
                    queue.residuals.push((0.5 / 16.0, view as u8));
                }
                queue.dealt_out = [16, 4];
                queue.end_note([0, 0]);
                sum += queue.told().map(|told| f64::from(told.saved)).sum::<f64>();
            }
            let saved = sum / f64::from(samples);
            assert!((saved - expected).abs() < 0.01, "{saved}, not {expected}");
        }
    }

    /// Eight rays from each of two parts of the dome, of which one has four times the light of the other: if all arrive none
    /// differs from the next, if half do so by chance their variances are 8/4 (4² + 1)/16².
    #[test]
    fn noise_is_what_differs_from_one_ray_to_the_next() {
        for (by_chance, controls, expected) in
            [(false, false, 0.0), (false, true, 0.0), (true, false, 17.0 / 128.0), (true, true, 17.0 / 128.0)]
        {
            let (mut sum, samples) = (0.0, 20_000);
            for sample in 0..samples {
                let mut queue = Queue { sample, ..Queue::default() };
                // Others stand before it in the queue.
                queue.push(Ray::new(Vec3::ZERO, Vec3::X), Vec3::ONE);
                for i in 0..16 {
                    let light = if i < 8 { 4.0 } else { 1.0 } / 16.0;
                    let arrives = if by_chance { (random::hash(&[sample, i, 7]) >> 31) as f32 } else { 1.0 };
                    queue.push(Ray::new(Vec3::ZERO, Vec3::X), Vec3::splat(arrives * light));
                    if controls {
                        queue.residuals.push((0.5 * light, 0));
                    }
                }
                queue.end_note([1, 0]);
                let told: Vec<_> = queue.told().collect();
                assert!(told.len() == 1 && told[0].sample == sample && told[0].saved == 0.0, "{told:?}");
                sum += f64::from(told[0].noise.expect("sixteen rays"));
            }
            let noise = sum / f64::from(samples);
            assert!((noise - expected).abs() < 0.005, "{noise}, not {expected}");
        }
    }

    /// Three rays of which half arrive by chance have a variance of 3/4, of which one pair tells two thirds.
    #[test]
    fn the_last_of_an_odd_number_of_rays_counts_and_one_alone_tells_nothing() {
        let told = |sample: u32, rays: u32| {
            let mut queue = Queue { sample, ..Queue::default() };
            for i in 0..rays {
                let arrives = (random::hash(&[sample, i, 7]) >> 31) as f32;
                queue.push(Ray::new(Vec3::ZERO, Vec3::X), Vec3::splat(arrives));
            }
            queue.end_note([0, 0]);
            queue.told().next().expect("one sample").noise
        };
        let noise = (0..20_000).filter_map(|sample| told(sample, 3)).sum::<f32>() / 20_000.0;
        assert!((noise - 0.75).abs() < 0.02, "{noise}");
        assert_eq!((told(0, 1), told(0, 0)), (None, None));
    }
}
