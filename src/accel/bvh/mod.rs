//! A bounding volume hierarchy in Rust: eight children a node, eight triangles a leaf, no library below it.
//!
//! Opaque and alpha-tested geometry stand in trees of their own, so that no mask is tested on the way: shadow rays
//! through the opaque part never see a leaf of foliage. A top tree holds the triangles of the world and the boxes of
//! the instances; each instanced mesh has a tree in its own space.
//!
//! `build` and `split` make the trees, `node` is what they are made of, `traverse` is a ray's way through them,
//! `packet` that of camera rays, and `portable`, `avx2` and `avx512` are the vector code it is written over, chosen when a structure is built.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod build;
mod node;
mod packet;
mod portable;
mod split;
mod traverse;

use super::placement::{self, Placement, Space};
use super::{Accel, AccelStats, Coherence, Hit, MakeAccel, Mask, Ray};
use crate::error::{Error, Result};
use crate::pages::{self, Pages};
use crate::registry::{Kind, Opt, Params, Plugin};
use crate::scene::Scene;
use build::{Primitive, Source, Tree};
use glam::{Affine3A, Vec3};
use node::{Forest, Root};
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;
use traverse::{Any, Closest, Kernel, Question, trace, trace_packets};

/// The plugin.
pub(super) const PLUGIN: Plugin<MakeAccel> = Plugin {
    name: "bvh",
    about: "a bounding volume hierarchy in Rust, without any library",
    options: &[Opt {
        key: "isa",
        kind: Kind::Choice(&["best", "avx512", "avx2", "portable"]),
        default: "best",
        about: "which vector code; best asks the processor",
    }],
    make: |scene, params, threads| Ok(Box::new(Bvh::new(scene, params, threads)?)),
};

/// Most bytes a triangle takes while its tree is built: itself, and the arenas' room for nodes and leaves …
const GROWING: u64 = 32 + 140;
/// … and in the forest that trees are copied to, where leaves are as good as full.
const GROWN: u64 = 64;

/// What takes less memory, where it is there.
const SMALLER: &str = if cfg!(feature = "embree") { ", or --accel embree:compact=on" } else { "" };

/// A shared mesh standing in the world.
#[derive(Debug)]
struct Placed {
    /// World to mesh.
    inverse: Affine3A,
    /// The mesh's tree.
    root: Root,
    /// Index into [`Scene::instances`].
    instance: u32,
}

/// All that rays can meet.
#[derive(Debug, Default)]
struct World {
    forest: Forest,
    /// The top trees of the opaque geometry and of the rest.
    tops: [Option<Root>; 2],
    placed: Vec<Placed>,
}

/// The batch calls of a kernel, chosen once.
#[derive(Debug, Clone, Copy)]
struct Questions {
    closest: fn(&World, &[Ray], Mask, Coherence, &mut [Hit]),
    any: fn(&World, &[Ray], Mask, &mut [u8]),
}

#[derive(Debug)]
struct Bvh {
    world: World,
    questions: Questions,
    limit: f32,
    stats: AccelStats,
    invalid: AtomicU64,
}

impl World {
    /// The nearest hits of a batch of valid rays.
    #[inline(always)]
    fn closest<K: Kernel>(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
        hits.fill(Hit::MISS);
        if coherence == Coherence::Incoherent {
            return self.ask::<K, Closest>(rays, mask, hits);
        }
        for root in self.roots(mask) {
            if self.placed.is_empty() {
                trace_packets::<K, false>(self, root, rays, hits);
            } else {
                trace_packets::<K, true>(self, root, rays, hits);
            }
        }
    }

    /// Whether anything lies on the rays of a batch.
    #[inline(always)]
    fn any<K: Kernel>(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
        occluded.fill(0);
        self.ask::<K, Any>(rays, mask, occluded);
    }

    #[inline(always)]
    fn ask<K: Kernel, Q: Question>(&self, rays: &[Ray], mask: Mask, answers: &mut [Q::Answer]) {
        for root in self.roots(mask) {
            if self.placed.is_empty() {
                trace::<K, Q, false>(self, root, rays, answers);
            } else {
                trace::<K, Q, true>(self, root, rays, answers);
            }
        }
    }

    /// The top trees that a mask sees.
    #[inline(always)]
    fn roots(&self, mask: Mask) -> impl Iterator<Item = Root> {
        self.tops
            .iter()
            .enumerate()
            .filter(move |(index, _)| mask as u32 >> index & 1 == 1)
            .filter_map(|(_, root)| *root)
    }
}

fn questions(isa: &str) -> Result<Questions> {
    #[cfg(target_arch = "x86_64")]
    let (avx512, avx2) = (avx512::questions(), avx2::questions());
    #[cfg(not(target_arch = "x86_64"))]
    let (avx512, avx2) = (None, None);
    let missing = || Error::Accel(format!("bvh: this processor has no {isa}: use isa=best"));
    match isa {
        "avx512" => avx512.ok_or_else(missing),
        "avx2" => avx2.ok_or_else(missing),
        "portable" => Ok(portable::QUESTIONS),
        _ => Ok(avx512.or(avx2).unwrap_or(portable::QUESTIONS)),
    }
}

/// A scene's geometry as the builder reads it: `Primitive::item` is an index into `parts`.
struct Parts<'a> {
    parts: Vec<Part<'a>>,
}

struct Part<'a> {
    positions: Cow<'a, [Vec3]>,
    indices: &'a [[u32; 3]],
    instance: u32,
}

impl Source for Parts<'_> {
    fn triangle(&self, primitive: &Primitive) -> ([Vec3; 3], u32) {
        let part = &self.parts[primitive.item as usize];
        let corners = part.indices[primitive.triangle as usize].map(|i| part.positions[i as usize]);
        (corners, part.instance)
    }
}

impl<'a> Parts<'a> {
    fn of(scene: &'a Scene, placements: &[&Placement]) -> Self {
        let part = |placement: &&Placement| Part {
            positions: placement.positions(scene),
            indices: &scene.meshes[placement.mesh as usize].indices,
            instance: placement.instance,
        };
        Self { parts: placements.iter().map(part).collect() }
    }

    fn triangles(&self) -> usize {
        self.parts.iter().map(|p| p.indices.len()).sum()
    }

    /// A primitive for every triangle, absent ones included, and the instances behind them.
    fn primitives(&self, instances: &[Primitive]) -> Pages<Primitive> {
        let mut primitives = Pages::zeroed(self.triangles() + instances.len());
        let (mut rest, last) = primitives.split_at_mut(self.triangles());
        last.copy_from_slice(instances);
        for (item, part) in self.parts.iter().enumerate() {
            let (own, others) = std::mem::take(&mut rest).split_at_mut(part.indices.len());
            rest = others;
            own.par_iter_mut().zip(part.indices).enumerate().with_min_len(1024).for_each(
                |(triangle, (to, indices))| {
                    let [a, b, c] = indices.map(|i| part.positions[i as usize]);
                    let (mut low, high) = (a.min(b).min(c), a.max(b).max(c));
                    if ![a, b, c].into_iter().all(placement::usable) {
                        low.x = Primitive::ABSENT;
                    }
                    *to = Primitive { low, item: item as u32, high, triangle: triangle as u32 };
                },
            );
        }
        primitives
    }
}

impl Bvh {
    fn new(scene: &Arc<Scene>, params: &Params, threads: usize) -> Result<Self> {
        let start = Instant::now();
        let questions = questions(params.word("isa"))?;
        let placements = placement::place(scene)?;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.max(1)).build();
        let pool = pool.map_err(|e| Error::Accel(format!("bvh: cannot start {threads} threads: {e}")))?;
        let (world, triangles, peak) = pool.install(|| World::new(scene, &placements))?;
        let bytes = world.forest.bytes() + size_of_val(world.placed.as_slice()) as u64;
        let build_s = start.elapsed().as_secs_f64();
        let stats = AccelStats { build_s, triangles, bytes, peak_bytes: peak.max(bytes), invalid_rays: 0 };
        Ok(Self { world, questions, limit: placement::ray_limit(&placements), stats, invalid: AtomicU64::new(0) })
    }
}

impl World {
    /// Also returns the number of triangles and the most bytes held.
    fn new(scene: &Scene, placements: &[Placement]) -> Result<(Self, u64, u64)> {
        let mut trees: Vec<Tree> = Vec::new();
        let (mut triangles, mut peak) = (0, 0);
        // Adds a tree; returns its place in the list, if it has anything in it.
        let mut plant = |parts: &Parts<'_>, instances: &[Primitive], trees: &mut Vec<Tree>| {
            triangles += parts.triangles() as u64;
            let needed = (parts.triangles() + instances.len()) as u64 * GROWING + triangles * GROWN;
            if !pages::are_free(needed as usize) {
                let mib = needed >> 20;
                return Err(Error::Accel(format!(
                    "bvh: out of memory: {mib} MiB more are needed to build: try a smaller scene{SMALLER}"
                )));
            }
            let mut primitives = parts.primitives(instances);
            let tree = build::build(parts, present(&mut primitives));
            trees.extend(tree);
            let held: u64 = trees.iter().map(Tree::bytes).sum();
            peak = peak.max(held + size_of_val(&*primitives) as u64);
            Ok(())
        };
        // Shared meshes first: their boxes are the instances'.
        let mut numbers = HashMap::new();
        let mut placed = Vec::new();
        let mut instances = [Vec::new(), Vec::new()];
        for placement in placements {
            let Space::Shared(inverse) = placement.space else { continue };
            if let Entry::Vacant(entry) = numbers.entry(placement.mesh) {
                let number = trees.len();
                plant(&Parts::of(scene, &[placement]), &[], &mut trees)?;
                entry.insert((trees.len() > number).then_some(number));
            }
            let Some(number) = numbers[&placement.mesh] else { continue };
            let (low, high) = moved(&trees[number].bounds, &scene.instances[placement.instance as usize].transform);
            let item = placed.len() as u32;
            placed.push((inverse, number, placement.instance));
            instances[placement.mask as usize - 1].push(Primitive {
                low,
                item,
                high,
                triangle: Primitive::IS_INSTANCE,
            });
        }
        let mut tops = [None, None];
        for (index, instances) in instances.iter().enumerate() {
            let own = |p: &&Placement| p.mask as usize - 1 == index && !matches!(p.space, Space::Shared(_));
            let parts = Parts::of(scene, &placements.iter().filter(own).collect::<Vec<_>>());
            let number = trees.len();
            plant(&parts, instances, &mut trees)?;
            tops[index] = (trees.len() > number).then_some(number);
        }
        if triangles + placed.len() as u64 >= u64::from(node::INSTANCE) {
            return Err(Error::Accel("bvh: more than 2^30 triangles: try a smaller scene".to_owned()));
        }
        let held: u64 = trees.iter().map(Tree::bytes).sum();
        let (forest, roots) = build::join(trees);
        let tops = tops.map(|number| number.map(|n| roots[n]));
        let placed = placed.into_iter().map(|(inverse, n, instance)| Placed { inverse, root: roots[n], instance });
        peak = peak.max(held + forest.bytes());
        Ok((Self { forest, tops, placed: placed.collect() }, triangles, peak))
    }
}

/// The primitives that have a place, moved to the front.
fn present(primitives: &mut [Primitive]) -> &mut [Primitive] {
    let absent = |p: &Primitive| p.low.x == Primitive::ABSENT;
    if !primitives.par_iter().any(absent) {
        return primitives;
    }
    primitives.sort_by_key(absent);
    let count = primitives.partition_point(|p| !absent(p));
    &mut primitives[..count]
}

/// The world box of a box in an instance's space, widened by what the rays' way into that space may lose.
fn moved(bounds: &node::Aabb, transform: &Affine3A) -> (Vec3, Vec3) {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for corner in 0..8 {
        let pick = |axis: usize| if corner >> axis & 1 == 1 { bounds.high[axis] } else { bounds.low[axis] };
        let p = transform.transform_point3(Vec3::new(pick(0), pick(1), pick(2)));
        (low, high) = (low.min(p), high.max(p));
    }
    let pad = (low.abs().max(high.abs()) + transform.translation.abs().max_element()) * 4.0 * f32::EPSILON;
    (low - pad, high + pad)
}

impl Accel for Bvh {
    fn intersect(&self, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
        assert_eq!(rays.len(), hits.len(), "a hit for every ray");
        let rays = placement::traceable(rays, self.limit, &self.invalid);
        (self.questions.closest)(&self.world, &rays, mask, coherence, hits);
    }

    fn occluded(&self, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
        assert_eq!(rays.len(), occluded.len(), "an answer for every ray");
        let rays = placement::traceable(rays, self.limit, &self.invalid);
        (self.questions.any)(&self.world, &rays, mask, occluded);
    }

    fn stats(&self) -> AccelStats {
        AccelStats { invalid_rays: self.invalid.load(Ordering::Relaxed), ..self.stats }
    }
}
