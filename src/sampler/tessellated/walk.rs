//! Directions for one point while the next one's begin.
//!
//! On its way down the hierarchy a number reads two tables that no cache holds: a group's buckets, and the cell that was
//! drawn. So the way is gone in three parts, each asking for the memory of the next, and between its parts a point
//! waits for its predecessor: [`Tessellated::begin`] for point i + 1 comes before [`Tessellated::walk`] for point i.

use super::Tessellated;
use super::draw::{Aimed, Block, Choose, Find};
use super::leaves::LeafMemo;
use super::normals::Aim;
use super::weights::{Purpose, Weights};
use crate::sampler::shadow_cache::NO_TARGET;
use crate::sampler::{DomeSampler, Draws, Numbers, Point, Prepared};
use crate::simd::dispatch;
use crate::vectors::Vectors;
use glam::Vec3;

/// What directions are asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Asked {
    normal: Vec3,
    numbers: Numbers,
    n: u32,
    sunless: bool,
}

impl Asked {
    pub(super) fn new(point: &Point, n: u32) -> Self {
        Self { normal: point.ns, numbers: point.numbers, n, sunless: point.sunless }
    }

    /// Whether small blocks serve.
    fn are_few(&self) -> bool {
        self.n <= FEW as u32
    }
}

/// How far a point's first block has come.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Stage {
    Asked,
    Chosen,
    Found,
}

/// A point whose directions have begun.
#[derive(Debug, Clone, Copy)]
struct Begun {
    asked: Asked,
    stage: Stage,
    /// What its weights are for, and where they were.
    purpose: Purpose,
    entry: usize,
    aim: Aim,
    /// The shadow cache's record that it reads.
    record: Option<u32>,
    /// Where its rays are counted.
    target: u32,
}

/// Numbers of a block: a register of them where there are so many, else a quarter of one.
const MANY: usize = 16;
const FEW: usize = 4;

/// The first block of the present point and of the next one, and blocks for what follows.
#[derive(Debug, Default)]
struct Blocks<const N: usize> {
    first: [Block<N>; 2],
    rest: [Block<N>; 2],
}

/// The present point and the next one.
#[derive(Debug, Default)]
pub struct Walk {
    begun: [Option<Begun>; 2],
    /// Which of the two has begun last.
    last: usize,
    many: Blocks<MANY>,
    few: Blocks<FEW>,
    leaves: LeafMemo,
}

impl Tessellated {
    /// Begins a point's directions and leads the one's that was begun before to their cells.
    pub(super) fn begin(&self, point: &Point, n: u32, out: &mut Draws) {
        let (record, target) = self.memory.consult(point, out);
        let record = record.map(|record| record.slot);
        let Prepared { memo, walk: Walk { begun, last, many, few, leaves }, .. } = &mut out.prepared;
        if let Some(Begun { asked, stage: stage @ Stage::Chosen, aim, .. }) = &mut begun[*last] {
            if asked.are_few() {
                self.find(&mut few.first[*last], *aim);
            } else {
                self.find(&mut many.first[*last], *aim);
            }
            *stage = Stage::Found;
        }
        if n == 0 {
            // All it wanted was its place in the cache.
            return;
        }
        *last = 1 - *last;
        let weights = self.weights(point, n, record, memo);
        let (asked, purpose, aim) = (Asked::new(point, n), weights.purpose, weights.aim);
        let stage = if weights.total > 0 { Stage::Chosen } else { Stage::Asked };
        if stage == Stage::Chosen {
            if asked.are_few() {
                self.choose(weights, leaves, &asked, 0, &mut few.first[*last]);
            } else {
                self.choose(weights, leaves, &asked, 0, &mut many.first[*last]);
            }
        }
        begun[*last] = Some(Begun { asked, stage, purpose, entry: memo.place(), aim, record, target });
    }

    /// All directions asked for, begun before or not.
    pub(super) fn walk(&self, point: &Point, n: u32, out: &mut Draws) {
        let asked = Asked::new(point, n);
        let of_point = |begun: &Option<Begun>| {
            begun.is_some_and(|b| b.asked == asked && b.purpose.version == self.memory.version())
        };
        if !out.prepared.walk.begun.iter().any(of_point) {
            self.begin(point, n, out);
        }
        let slot = usize::from(!of_point(&out.prepared.walk.begun[0]));
        let begun = out.prepared.walk.begun[slot].take().expect("it has begun");
        let Draws { dir, radiance, pdf, control, shown, integral, integral_shown, target: targets, prepared, .. } = out;
        let Prepared { memo, walk: Walk { many, few, leaves, .. }, .. } = prepared;
        let record = begun.record;
        if !memo.recall(&begun.purpose, begun.entry) {
            self.weights(point, n, record, memo);
        }
        let weights = memo.current();
        *integral = weights.integral(point.ns);
        let shown = (!weights.shown.is_empty()).then(|| {
            *integral_shown = weights.integral_shown(point.ns);
            (&weights.shown[..], shown)
        });
        if weights.total == 0 {
            return;
        }
        let control = record.is_some().then_some(control);
        let listens = self.listens();
        let mut lists =
            Lists { dir, radiance, pdf, control, visibility: None, shown, targets, target: begun.target, listens };
        let weights = (weights, leaves);
        if asked.are_few() {
            let Blocks { first, rest: [rest, _] } = few;
            self.descend(weights, &asked, begun.stage, [&mut first[slot], rest], &mut lists);
        } else {
            let Blocks { first, rest: [rest, _] } = many;
            self.descend(weights, &asked, begun.stage, [&mut first[slot], rest], &mut lists);
        }
    }

    /// Directions for a point's lobe.
    pub(super) fn walk_by(&self, asked: &Asked, (target, visibility): (u32, Option<&[u8]>), out: &mut Draws) {
        let Draws { dir, radiance, pdf, control, target: targets, prepared: Prepared { lobe, walk, .. }, .. } = out;
        let control = visibility.is_some().then_some(control);
        let listens = self.listens();
        let mut lists = Lists { dir, radiance, pdf, control, visibility, shown: None, targets, target, listens };
        let Walk { many, few, leaves, .. } = walk;
        if asked.are_few() {
            self.descend((lobe, leaves), asked, Stage::Asked, few.rest.each_mut(), &mut lists);
        } else {
            self.descend((lobe, leaves), asked, Stage::Asked, many.rest.each_mut(), &mut lists);
        }
    }

    fn choose<const N: usize>(
        &self,
        weights: &Weights,
        leaves: &mut LeafMemo,
        asked: &Asked,
        first: u32,
        block: &mut Block<N>,
    ) {
        let &Asked { numbers, n, .. } = asked;
        let count = (n - first).min(N as u32) as usize;
        dispatch(Choose { sampler: self, weights, leaves, numbers, first, count, of: n, block });
    }

    fn find<const N: usize>(&self, block: &mut Block<N>, aim: Aim) {
        dispatch(Find { sampler: self, aim, block });
    }

    /// Block after block, each a part ahead of the one before.
    fn descend<const N: usize>(
        &self,
        (weights, leaves): (&Weights, &mut LeafMemo),
        asked: &Asked,
        stage: Stage,
        [mut block, mut ahead]: [&mut Block<N>; 2],
        lists: &mut Lists<'_>,
    ) {
        if stage == Stage::Asked {
            self.choose(weights, leaves, asked, 0, block);
        }
        if stage != Stage::Found {
            self.find(block, weights.aim);
        }
        for next in (0..asked.n).step_by(N).skip(1).map(Some).chain([None]) {
            if let Some(next) = next {
                self.choose(weights, leaves, asked, next, ahead);
            }
            dispatch(Aimed { sampler: self, normal: asked.normal, block });
            lists.add(block);
            if next.is_some() {
                self.find(ahead, weights.aim);
                std::mem::swap(&mut block, &mut ahead);
            }
        }
    }
}

/// Where directions are written.
struct Lists<'a> {
    dir: &'a mut Vectors,
    radiance: &'a mut Vectors,
    pdf: &'a mut Vec<f32>,
    /// The control variate, if there is one.
    control: Option<&'a mut Vec<f32>>,
    /// For a lobe, in its place: the groups' visibility in 255ths.
    visibility: Option<&'a [u8]>,
    /// What a wide lobe is taken to show of each group, if there is one, and where that is written.
    shown: Option<(&'a [f32], &'a mut Vec<f32>)>,
    targets: &'a mut Vec<u32>,
    target: u32,
    listens: bool,
}

impl Lists<'_> {
    #[inline]
    fn add<const N: usize>(&mut self, block: &Block<N>) {
        // Whole blocks, whose copies need no call, less what does not count.
        let end = self.dir.len() + block.count;
        self.dir.extend(&block.dir);
        self.dir.truncate(end);
        self.radiance.extend(&block.radiance);
        self.radiance.truncate(end);
        self.pdf.extend_from_slice(&block.pdf);
        self.pdf.truncate(end);
        if let Some(control) = &mut self.control {
            match self.visibility {
                Some(visibility) => control.extend(
                    block.group[..block.count].iter().map(|&g| f32::from(visibility[g as usize]) * (1.0 / 255.0)),
                ),
                None => control.extend_from_slice(&block.factor),
            }
            control.truncate(end);
        }
        if let Some((of_groups, shown)) = &mut self.shown {
            shown.extend(block.group[..block.count].iter().map(|&g| of_groups[g as usize]));
        }
        if self.listens {
            let none = self.target == NO_TARGET;
            self.targets
                .extend_from_slice(&block.group.map(|group| if none { NO_TARGET } else { self.target + group }));
            self.targets.truncate(end);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dome::{Dome, Faults, project::Grid};
    use crate::registry::resolve;
    use crate::sampler::Setup;
    use crate::sampler::tessellated::tests::point;
    use crate::sampler::tessellated::{Memo, PLUGIN};
    use std::sync::Arc;

    /// Whole blocks and parts of one, for normals with groups at their horizon.
    #[test]
    fn small_blocks_and_large_ones_lead_to_the_same_directions() {
        let grid = Grid::new(64, 32, 0.0);
        let texels = (0..grid.len()).map(|texel| [0.1 + (texel % 7) as f32; 3]).collect();
        let dome = Arc::new(Dome { grid, texels, faults: Faults::default() });
        let (_, params) = resolve("sampler", &[PLUGIN], "tessellated:cache=off").unwrap();
        let sampler = Tessellated::new(&dome, &params, &Setup { size: [64, 64], gloss: false, rays: 64, spp: 1 });
        for (n, normal) in (1..=21).flat_map(|n| [(n, Vec3::Y), (n, Vec3::new(0.48, -0.6, 0.64))]) {
            let mut memo = Memo::default();
            let weights = sampler.weights(&point(normal, n), n, None, &mut memo);
            let asked = Asked { normal, numbers: Numbers { seed: n, sample: 1 }, n, sunless: false };
            let (small, large) =
                (descended::<FEW>(&sampler, weights, &asked), descended::<MANY>(&sampler, weights, &asked));
            assert_eq!(small.dir.len(), n as usize);
            assert_eq!((&small.dir, &small.radiance, &small.pdf), (&large.dir, &large.radiance, &large.pdf), "{n}");
            assert_eq!((&small.target, &small.control), (&large.target, &large.control), "{n}");
        }
    }

    fn descended<const N: usize>(sampler: &Tessellated, weights: &Weights, asked: &Asked) -> Draws {
        let mut draws = Draws::default();
        let Draws { dir, radiance, pdf, control, target: targets, .. } = &mut draws;
        let control = Some(control);
        let mut lists =
            Lists { dir, radiance, pdf, control, visibility: None, shown: None, targets, target: 7, listens: true };
        let (mut block, mut ahead) = (Block::<N>::default(), Block::default());
        let mut leaves = LeafMemo::default();
        let blocks = [&mut block, &mut ahead];
        sampler.descend((weights, &mut leaves), asked, Stage::Asked, blocks, &mut lists);
        draws
    }
}
