//! Lambertian points, which most are: what each direction adds, many at a time.

use super::Queue;
use super::dealt::{Dealt, HANDS};
use crate::accel::Ray;
use crate::sampler::Draws;
use crate::simd::{Kernel, dispatch};
use crate::vectors::Vectors;
use glam::Vec3;

/// A direction is traced.
pub(super) const TRACED: u32 = 0;
/// It is below a horizon of the surface's: no ray, but it counts.
const HIDDEN: u32 = 1;
/// No light comes from there.
const BLACK: u32 = 2;

/// A point that reflects all light alike.
#[derive(Debug, Clone, Copy)]
pub struct Lambert {
    /// Where its rays begin.
    pub origin: Vec3,
    /// Unit geometric normal on the viewer's side.
    pub ng: Vec3,
    /// Unit shading normal on the viewer's side.
    pub ns: Vec3,
    /// Reflectance/π.
    pub k: Vec3,
}

impl Lambert {
    /// Whether all is the same but where rays begin.
    #[inline]
    pub(super) fn is_like(&self, other: &Self) -> bool {
        (self.ng, self.ns, self.k) == (other.ng, other.ns, other.k)
    }

    /// Queues all directions drawn for the point, or where they are dealt out, for those that [`Queue::dealt`] says; returns
    /// what is reflected of their control variate in the mean, W·m⁻²·sr⁻¹ a channel.
    #[inline]
    pub(super) fn queue(&self, is_dealt: bool, draws: &mut Draws, queue: &mut Queue) -> Vec3 {
        let (count, first) = (draws.dir.len(), queue.rays.len());
        draws.fate.clear();
        let Draws { dir, radiance, pdf, control, fate, target, .. } = draws;
        let weigh = Weigh {
            point: self,
            dealt: &queue.dealt,
            share: 1.0 / count as f32,
            dir: dir.rows(),
            radiance: radiance.rows(),
            pdf,
            control,
            fate,
            contributions: &mut queue.contributions,
        };
        let (all_traced, control) =
            if is_dealt && !weigh.dealt.is_flat { dispatch(WeighDealt(weigh)) } else { dispatch(weigh) };
        let origin = |dealt: &Dealt, i: usize| if is_dealt { dealt.origin[i % HANDS] } else { self.origin };
        if all_traced {
            let dealt = &queue.dealt;
            queue.rays.extend(dir.iter().enumerate().map(|(i, dir)| Ray::new(origin(dealt, i), dir)));
            queue.targets.extend_from_slice(target);
        } else {
            for (i, &fate) in fate.iter().enumerate() {
                let target = target.get(i);
                if fate == TRACED {
                    queue.contributions.copy(first + i, queue.rays.len());
                    queue.rays.push(Ray::new(origin(&queue.dealt, i), dir.get(i)));
                    queue.targets.extend(target);
                } else if fate == HIDDEN
                    && let Some(&target) = target
                {
                    queue.hide(target);
                }
            }
            queue.contributions.resize(queue.rays.len(), queue.rays.len());
        }
        queue.add((queue.rays.len() - first) as u32);
        control / count as f32
    }
}

/// Directions treated together.
const LANES: usize = HANDS;
const QUARTER: usize = 4;

/// What each direction adds, and whether it is traced; whether all are, and the sum of the control variate as it is reflected.
struct Weigh<'a> {
    point: &'a Lambert,
    dealt: &'a Dealt,
    /// One direction's.
    share: f32,
    dir: [&'a [f32]; 3],
    radiance: [&'a [f32]; 3],
    pdf: &'a [f32],
    /// Empty where there is none.
    control: &'a [f32],
    fate: &'a mut Vec<u32>,
    contributions: &'a mut Vectors,
}

impl Kernel for Weigh<'_> {
    type Output = (bool, Vec3);

    #[inline(always)]
    fn run(self) -> (bool, Vec3) {
        self.all::<false>()
    }
}

/// The same where other points have their share, and do not only lie elsewhere.
struct WeighDealt<'a>(Weigh<'a>);

impl Kernel for WeighDealt<'_> {
    type Output = (bool, Vec3);

    #[inline(always)]
    fn run(self) -> (bool, Vec3) {
        self.0.all::<true>()
    }
}

impl Weigh<'_> {
    #[inline(always)]
    fn all<const DEALT: bool>(mut self) -> (bool, Vec3) {
        let count = self.pdf.len();
        let mut totals = Totals { any: [TRACED; LANES], control: [[0.0; LANES]; 3] };
        // What does not fill a register goes in quarters of one, then one by one: copied to one and back it would take longer.
        let (whole, quarters) = (count - count % LANES, count - count % QUARTER);
        for at in (0..whole).step_by(LANES) {
            self.some::<LANES, DEALT>(at, &mut totals);
        }
        for at in (whole..quarters).step_by(QUARTER) {
            self.some::<QUARTER, DEALT>(at, &mut totals);
        }
        for at in quarters..count {
            self.some::<1, DEALT>(at, &mut totals);
        }
        if DEALT {
            for (control, k) in totals.control.as_flattened_mut().iter_mut().zip(self.dealt.k.as_flattened()) {
                *control *= k;
            }
        }
        let control = Vec3::from(totals.control.map(|of_lanes| of_lanes.iter().sum()));
        let control = if DEALT { control } else { control * self.point.k };
        (totals.any.into_iter().fold(TRACED, |all, fate| all | fate) == TRACED, control)
    }
}

/// What many directions come to, lane by lane.
struct Totals {
    /// All fates.
    any: [u32; LANES],
    /// The control variate's sum, a channel each.
    control: [[f32; LANES]; 3],
}

impl Weigh<'_> {
    /// So many from `at` on, which is as far as it has come.
    #[inline(always)]
    fn some<const N: usize, const DEALT: bool>(&mut self, at: usize, totals: &mut Totals) {
        let Self { point, dealt, share, dir, radiance, pdf, control, fate, contributions } = self;
        let lane = at % LANES;
        let (ns, ng) = (rows::<N>(&dealt.ns, lane), rows::<N>(&dealt.ng, lane));
        // In arrays of its own the compiler sees that nothing it writes is what it reads.
        let (x, y, z) = (chunk::<N>(dir[0], at), chunk::<N>(dir[1], at), chunk::<N>(dir[2], at));
        let (r, g, b) = (chunk::<N>(radiance[0], at), chunk::<N>(radiance[1], at), chunk::<N>(radiance[2], at));
        let pdf = chunk::<N>(pdf, at);
        let (mut weight, mut fates) = ([0.0; N], [TRACED; N]);
        for i in 0..N {
            let towards = |of_lanes: &[[f32; N]; 3], own: Vec3| match DEALT {
                true => x[i] * of_lanes[0][i] + y[i] * of_lanes[1][i] + z[i] * of_lanes[2][i],
                false => x[i] * own.x + y[i] * own.y + z[i] * own.z,
            };
            let (cosine, above) = (towards(&ns, point.ns), towards(&ng, point.ng));
            // What is no number is not hidden: it is traced, found out and counted.
            let hidden = if (cosine <= 0.0) | (above <= 0.0) { HIDDEN } else { TRACED };
            fates[i] = if (r[i] == 0.0) & (g[i] == 0.0) & (b[i] == 0.0) { BLACK } else { hidden };
            weight[i] = cosine / pdf[i];
        }
        let mut adds = [[0.0; N]; 3];
        let k = rows::<N>(&dealt.k, lane);
        for (((adds, light), k), own) in adds.iter_mut().zip([&r, &g, &b]).zip(&k).zip((point.k * *share).to_array()) {
            for i in 0..N {
                adds[i] = light[i] * (if DEALT { k[i] * *share } else { own } * weight[i]);
            }
        }
        contributions.extend(&adds);
        fate.extend_from_slice(&fates);
        for (any, fate) in totals.any[lane..].iter_mut().zip(fates) {
            *any |= fate;
        }
        if !control.is_empty() {
            let control = chunk::<N>(control, at);
            for (total, light) in totals.control.iter_mut().zip([&r, &g, &b]) {
                for i in 0..N {
                    total[lane + i] += light[i] * (control[i] / pdf[i]);
                }
            }
        }
    }
}

/// The numbers from `at` on of all rows.
#[inline(always)]
fn rows<const N: usize>(rows: &[[f32; HANDS]; 3], at: usize) -> [[f32; N]; 3] {
    [chunk(&rows[0], at), chunk(&rows[1], at), chunk(&rows[2], at)]
}

/// The numbers from `at` on.
#[inline(always)]
fn chunk<const N: usize>(row: &[f32], at: usize) -> [f32; N] {
    let mut chunk = [0.0; N];
    chunk.copy_from_slice(&row[at..at + N]);
    chunk
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::Dome;
    use crate::integrator::Post;
    use crate::random;

    /// Against the same one direction after another: whole vectors and what is left of them, all traced and not, for one
    /// point alone and dealt out to two that lie elsewhere, or differ in all.
    #[test]
    fn many_at_a_time_are_queued_like_one_by_one() {
        let unit = |i: u32, purpose: u32| random::unit(random::hash(&[i, purpose]));
        let (ns, ng) = (Vec3::Y, Vec3::new(0.6, 0.8, 0.0));
        let point = Lambert { origin: Vec3::splat(2.0), ng, ns, k: Vec3::new(0.1, 0.2, 0.3) };
        let elsewhere = Lambert { origin: Vec3::splat(3.0), ..point };
        let other = Lambert { origin: Vec3::X, ng: Vec3::Y, ns: Vec3::new(0.0, 0.8, 0.6), k: Vec3::new(0.3, 0.1, 0.0) };
        let deals = [None, Some(elsewhere), Some(other)];
        for (deal, (count, lowest)) in deals
            .into_iter()
            .flat_map(|deal| [(1, 0.9), (16, 0.9), (16, -1.0), (21, -1.0), (53, 0.7)].map(|case| (deal, case)))
        {
            let (mut draws, mut queue) = (Draws::default(), Queue { sample: 7, ..Queue::default() });
            // Something stands before it in the queue.
            queue.push(Ray::new(Vec3::ZERO, Vec3::X), Vec3::ONE);
            queue.targets.push(9);
            let post = |lambert, expected| Post { alike: (1, false), directions: 1, lambert, expected };
            let own = post(point, Vec3::ONE);
            let posts = [Some(own), None, deal.map(|deal| post(deal, Vec3::splat(0.25))), None];
            let hand = queue.dealt.deal(&own, &posts, count as usize, None);
            let whose = |i: u32| deal.filter(|_| i % 16 % 4 == 2).unwrap_or(point);
            let k = (0..count).map(|i| whose(i).k).sum::<Vec3>() / count as f32;
            let moved = (0..count).filter(|i| deal.is_some() && i % 16 % 4 == 2).count() as f32;
            assert!(
                (hand.k - k).abs().max_element() < 1e-6 && (hand.beside.x - 0.75 * moved / count as f32).abs() < 1e-6
            );
            let (mut rays, mut hidden, mut residuals, mut control) = (Vec::new(), Vec::new(), Vec::new(), Vec3::ZERO);
            for i in 0..count {
                let up = lowest + (1.0 - lowest) * unit(i, 0);
                let dir = Vec3::new((1.0 - up * up).sqrt() * if i % 2 == 0 { 1.0 } else { -1.0 }, up, 0.0);
                let black = lowest < 0.0 && i % 8 == 3;
                let radiance = if black { Vec3::ZERO } else { Vec3::new(unit(i, 1), unit(i, 2), unit(i, 3)) };
                let (pdf, of_control) = (0.1 + unit(i, 4), unit(i, 5));
                draws.push(dir, radiance, pdf);
                draws.control.push(of_control);
                draws.target.push(100 + i);
                let Lambert { origin, ng, ns, k } = whose(i);
                let controlled = k * radiance * (of_control / pdf) / count as f32;
                control += controlled;
                if dir.dot(ns) <= 0.0 || dir.dot(ng) <= 0.0 {
                    hidden.extend((!black).then_some((100 + i, 1 + rays.len() as u32)));
                } else if !black {
                    let adds = radiance * k / count as f32 * (dir.dot(ns) / pdf);
                    let view = if deal.is_some() && i % 16 % 4 == 2 { 2 } else { 0 };
                    rays.push((Ray::new(origin, dir), adds, 100 + i));
                    residuals.push((Dome::weight(controlled.to_array()), view));
                }
            }
            assert_eq!(lowest < 0.0, rays.len() < count as usize, "both kinds are tried");
            let reflected = point.queue(deal.is_some(), &mut draws, &mut queue);
            assert!((reflected - control).abs().max_element() < 1e-6, "{count}: {reflected}, not {control}");
            match deal {
                Some(_) => queue.note_dealt(&draws, &own, &posts),
                None => queue.note(&draws, point.k),
            }
            assert_eq!(queue.residuals.len(), residuals.len());
            for (noted, of_ray) in queue.residuals.iter().zip(residuals) {
                assert!((noted.0 - of_ray.0).abs() < 1e-6 && noted.1 == of_ray.1, "{noted:?}, not {of_ray:?}");
            }
            assert_eq!((queue.rays.len(), queue.contributions.len()), (1 + rays.len(), 1 + rays.len()));
            assert_eq!(queue.samples, [(7, 1 + rays.len() as u32)]);
            assert_eq!(queue.hidden, hidden);
            for (i, (ray, adds, target)) in rays.into_iter().enumerate() {
                assert_eq!((queue.rays[1 + i], queue.targets[1 + i]), (ray, target));
                let off = (queue.contributions.get(1 + i) - adds).abs().max_element();
                assert!(off <= 1e-6 * adds.max_element(), "{count}, ray {i}: off by {off}");
            }
        }
    }
}
