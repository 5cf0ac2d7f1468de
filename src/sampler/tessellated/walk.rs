//! Directions for one point while the next one's begin.
//!
//! On its way down the hierarchy a number reads two tables that no cache holds: a group's buckets, and the cell that was
//! drawn. So the way is gone in three parts, each asking for the memory of the next, and between its parts a point
//! waits for its predecessor: [`Tessellated::begin`] for point i + 1 comes before [`Tessellated::walk`] for point i.

use super::Tessellated;
use super::draw::{Aimed, BLOCK, Block, Choose, Find};
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
}

impl Asked {
    pub(super) fn new(point: &Point, n: u32) -> Self {
        Self { normal: point.ns, numbers: point.numbers, n }
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

/// The present point and the next one, each with its first block; and blocks for what follows.
#[derive(Debug, Default)]
pub struct Walk {
    begun: [Option<Begun>; 2],
    first: [Block; 2],
    /// Which of the two has begun last.
    last: usize,
    rest: [Block; 2],
    leaves: LeafMemo,
}

impl Tessellated {
    /// Begins a point's directions and leads the one's that was begun before to their cells.
    pub(super) fn begin(&self, point: &Point, n: u32, out: &mut Draws) {
        let (record, target) = self.memory.consult(point, out);
        let record = record.map(|record| record.slot);
        let Prepared { memo, walk: Walk { begun, first, last, leaves, .. }, .. } = &mut out.prepared;
        if let Some(Begun { stage: stage @ Stage::Chosen, aim, .. }) = &mut begun[*last] {
            dispatch(Find { sampler: self, aim: *aim, block: &mut first[*last] });
            *stage = Stage::Found;
        }
        *last = 1 - *last;
        let weights = self.weights(point.ns, n, record, memo);
        let (asked, purpose, aim) = (Asked::new(point, n), weights.purpose, weights.aim);
        let stage = if n > 0 && weights.total > 0 { Stage::Chosen } else { Stage::Asked };
        if stage == Stage::Chosen {
            self.choose(weights, leaves, &asked, 0, &mut first[*last]);
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
        let Draws { dir, radiance, pdf, control, integral, target: targets, prepared, .. } = out;
        let Prepared { memo, walk: Walk { first, rest: [rest, _], leaves, .. }, .. } = prepared;
        let record = begun.record;
        if !memo.recall(&begun.purpose, begun.entry) {
            self.weights(point.ns, n, record, memo);
        }
        let weights = memo.current();
        *integral = weights.integral(point.ns);
        if weights.total == 0 {
            return;
        }
        let mut lists = Lists { dir, radiance, pdf, targets, target: begun.target, listens: self.listens() };
        self.descend((weights, leaves), &asked, begun.stage, [&mut first[slot], rest], |block| {
            lists.add(block);
            if record.is_some() {
                let end = control.len() + block.count;
                control.extend_from_slice(&block.factor);
                control.truncate(end);
            }
        });
    }

    /// Directions for a point's lobe.
    pub(super) fn walk_by(&self, asked: &Asked, target: u32, out: &mut Draws) {
        let Draws { dir, radiance, pdf, target: targets, prepared: Prepared { lobe, walk, .. }, .. } = out;
        let mut lists = Lists { dir, radiance, pdf, targets, target, listens: self.listens() };
        let Walk { rest: [block, ahead], leaves, .. } = walk;
        self.descend((lobe, leaves), asked, Stage::Asked, [block, ahead], |block| lists.add(block));
    }

    fn choose(&self, weights: &Weights, leaves: &mut LeafMemo, asked: &Asked, first: u32, block: &mut Block) {
        let &Asked { numbers, n, .. } = asked;
        let count = (n - first).min(BLOCK as u32) as usize;
        dispatch(Choose { sampler: self, weights, leaves, numbers, first, count, of: n, block });
    }

    /// Block after block, each a part ahead of the one before.
    fn descend(
        &self,
        (weights, leaves): (&Weights, &mut LeafMemo),
        asked: &Asked,
        stage: Stage,
        [mut block, mut ahead]: [&mut Block; 2],
        mut emit: impl FnMut(&Block),
    ) {
        let find = |block: &mut Block| dispatch(Find { sampler: self, aim: weights.aim, block });
        if stage == Stage::Asked {
            self.choose(weights, leaves, asked, 0, block);
        }
        if stage != Stage::Found {
            find(block);
        }
        for next in (0..asked.n).step_by(BLOCK).skip(1).map(Some).chain([None]) {
            if let Some(next) = next {
                self.choose(weights, leaves, asked, next, ahead);
            }
            dispatch(Aimed { sampler: self, normal: asked.normal, block });
            emit(block);
            if next.is_some() {
                find(ahead);
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
    targets: &'a mut Vec<u32>,
    target: u32,
    listens: bool,
}

impl Lists<'_> {
    #[inline]
    fn add(&mut self, block: &Block) {
        // Whole blocks, whose copies need no call, less what does not count.
        let end = self.dir.len() + block.count;
        self.dir.extend(&block.dir);
        self.dir.truncate(end);
        self.radiance.extend(&block.radiance);
        self.radiance.truncate(end);
        self.pdf.extend_from_slice(&block.pdf);
        self.pdf.truncate(end);
        if self.listens {
            let none = self.target == NO_TARGET;
            self.targets
                .extend_from_slice(&block.group.map(|group| if none { NO_TARGET } else { self.target + group }));
            self.targets.truncate(end);
        }
    }
}
