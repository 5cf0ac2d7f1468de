//! What the image's own shadow rays saw, by place and group of triangles.
//!
//! A record belongs to a block of pixels, a dominant axis of the surface normal and a range of distances: keyed relative
//! to the pixel's footprint by construction, never to metres, and bounded by the image's size. It counts, for each
//! group of the tessellation, rays and rays that arrived. Between stages the counts of a record and of those around it
//! become visibilities m (`posterior`).
//!
//! Counts are integers and a block is only ever written by the tile that owns it, in the order of its pixels: the cache
//! is the same for any number of threads.

mod posterior;

use super::preconvolution::GROUP_LANES;
use glam::Vec3;
use posterior::{Member, Posterior, REGION, Taken};
use rayon::prelude::*;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicU16, AtomicU32, AtomicU64, Ordering::Relaxed};

/// Records a block may hold: few have more than two surfaces in sight.
const SLOTS: usize = 2;

/// Blocks each way beyond a point's own in which a record is looked for.
const FAR: i32 = 2;

/// Counts are halved when they reach this many rays: what was seen long ago fades.
const MOST: u16 = 128;

/// Records this many steps of distance apart still speak of the same surface.
const NEAR: u32 = 2;

/// What a slot's key takes, counted and frozen, and who speaks for it.
const KEY_BYTES: usize = 3 * 4;

/// What a slot's expected irradiance takes beside it ([`super::tessellated`]).
const EXPECTED_BYTES: usize = 32 * 4;

/// The axes of records' normals, as keys count them.
pub const AXES: [Vec3; 6] = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];

/// The target of a ray that nothing is learned from.
pub const NO_TARGET: u32 = u32::MAX;

/// The cache.
#[derive(Debug)]
pub struct ShadowCache {
    groups: usize,
    block: u32,
    blocks: [u32; 2],
    /// The record's key in each slot of each block, 0 for none.
    keys: Vec<AtomicU32>,
    /// Rays in the high byte, rays that arrived in the low one.
    counts: Vec<AtomicU16>,
    /// m in 255ths, as of the last stage.
    visibility: Vec<u8>,
    /// Which slots `visibility` speaks of.
    frozen: Vec<u32>,
    /// The slot whose `visibility` speaks for each of them.
    speaker: Vec<u32>,
    lookups: AtomicU64,
    hits: AtomicU64,
}

/// A record that was found.
#[derive(Debug, Clone, Copy)]
pub struct Record<'a> {
    /// Where it is kept.
    pub slot: u32,
    /// m of each group in 255ths.
    pub visibility: &'a [u8],
}

/// The place along the Z-curve of the square in a column and row, 65 536 each at most.
fn along_curve(square: [u32; 2]) -> u32 {
    // Each step moves the upper half of every group of bits up by as many as a group's half has.
    let [x, y] = square.map(|bits| {
        [(8, 0x00ff_00ff), (4, 0x0f0f_0f0f), (2, 0x3333_3333), (1, 0x5555_5555)]
            .iter()
            .fold(bits & 0xffff, |bits, &(by, kept)| (bits | bits << by) & kept)
    });
    x | y << 1
}

impl ShadowCache {
    /// A cache for an image of `size` pixels and `groups` groups (in [`GROUP_LANES`] lanes) within `budget` bytes.
    /// The block's side follows from the budget; at least `least` pixels.
    pub fn new(size: [u32; 2], groups: usize, budget: u64, least: u32) -> Self {
        debug_assert!(groups.is_multiple_of(GROUP_LANES));
        let bytes_a_block = (SLOTS * (groups * 3 + KEY_BYTES + EXPECTED_BYTES)) as u64;
        let mut block = least.max(1);
        let blocks_of = |block: u32| size.map(|side| side.div_ceil(block).max(1));
        while blocks_of(block).map(u64::from).iter().product::<u64>() * bytes_a_block > budget && block < 4096 {
            block += 1;
        }
        let blocks = blocks_of(block);
        let slots = blocks.map(|b| b as usize).iter().product::<usize>() * SLOTS;
        Self {
            groups,
            block,
            blocks,
            keys: bytemuck::zeroed_vec(slots),
            counts: bytemuck::zeroed_vec(slots * groups),
            visibility: vec![0; slots * groups],
            frozen: vec![0; slots],
            speaker: vec![0; slots],
            lookups: AtomicU64::new(0),
            hits: AtomicU64::new(0),
        }
    }

    /// The dominant axis of a normal, an index of [`AXES`].
    #[inline]
    pub fn axis(normal: Vec3) -> usize {
        let a = normal.abs();
        let (axis, along) = if a.x >= a.y && a.x >= a.z {
            (0, normal.x)
        } else if a.y >= a.z {
            (1, normal.y)
        } else {
            (2, normal.z)
        };
        2 * axis + usize::from(along < 0.0)
    }

    /// The key of a surface: the normal's dominant axis and the distance's octave-fraction. Never 0.
    #[inline]
    pub fn key(normal: Vec3, distance: f32, jitter: f32) -> u32 {
        // Four steps an octave: the exponent and the mantissa's first two bits, moved by the jitter.
        const STEP: u32 = 21;
        let bits = distance.max(1e-30).to_bits() as i32 + (jitter * (1 << STEP) as f32) as i32;
        let step = bits as u32 >> STEP;
        1 + Self::axis(normal) as u32 + (step << 3)
    }

    fn block_of(&self, x: f32, y: f32) -> [i32; 2] {
        let side = self.block as f32;
        let clamp = |v: f32, n: u32| ((v / side) as u32).min(n - 1) as i32;
        [clamp(x, self.blocks[0]), clamp(y, self.blocks[1])]
    }

    /// The slots of a block: those of a row of blocks follow each other, the first of each, then the second of each. Most
    /// blocks hold one record, and memory without records is never touched.
    fn slots_of(&self, [x, y]: [usize; 2]) -> impl Iterator<Item = usize> + Clone {
        let row = self.blocks[0] as usize;
        (0..SLOTS).map(move |slot| (y * SLOTS + slot) * row + x)
    }

    /// The slot of the frozen record that a point reads: of its kind of surface, at the distance nearest to its own. `jitter` (two
    /// numbers in [−½, ½)) moves the look-up by up to half a block, so that the edges of blocks turn into noise. Where
    /// nobody has been yet, a record near by has to do.
    pub fn find(&self, pixel: [u32; 2], key: u32, jitter: [f32; 2]) -> Option<u32> {
        let moved = self.moved(pixel, jitter);
        let own = self.moved(pixel, [0.0; 2]);
        let found = self.nearest(moved, key).or_else(|| self.nearest(own, key));
        found.or_else(|| self.near_by(own, key)).map(|slot| self.speaker[slot])
    }

    /// The block that a look-up falls to.
    fn moved(&self, pixel: [u32; 2], jitter: [f32; 2]) -> [i32; 2] {
        let side = self.block as f32;
        let [x, y] = [0, 1].map(|i| (pixel[i] as f32 + 0.5 + jitter[i] * side).max(0.0));
        self.block_of(x, y)
    }

    /// The place along the Z-curve of the block that a look-up falls to: squares of blocks may share what they are taken for.
    pub fn place(&self, pixel: [u32; 2], jitter: [f32; 2]) -> u32 {
        let [x, y] = self.moved(pixel, jitter);
        along_curve([x as u32, y as u32])
    }

    /// A record of the kind in the rings of blocks around one, the nearest first.
    #[cold]
    fn near_by(&self, [x, y]: [i32; 2], key: u32) -> Option<usize> {
        let ring = |far: i32| {
            let along = move |dy: i32| (-far..=far).step_by(if dy.abs() == far { 1 } else { 2 * far as usize });
            (-far..=far).flat_map(move |dy| along(dy).map(move |dx| [x + dx, y + dy]))
        };
        (1..=FAR).flat_map(ring).find_map(|block| self.nearest(block, key))
    }

    fn nearest(&self, block: [i32; 2], key: u32) -> Option<usize> {
        let [x, y] = block;
        let within = (0..self.blocks[0] as i32).contains(&x) && (0..self.blocks[1] as i32).contains(&y);
        let slots = within.then(|| self.slots_of([x as usize, y as usize]))?;
        let alike = slots.filter(|&slot| self.frozen[slot] & 7 == key & 7 && self.frozen[slot] != 0);
        alike
            .min_by_key(|&slot| (self.frozen[slot] >> 3).abs_diff(key >> 3))
            .filter(|&slot| (self.frozen[slot] >> 3).abs_diff(key >> 3) <= NEAR)
    }

    /// Where the rays of a point are counted: the index of its first group, [`NO_TARGET`] when its block is full.
    pub fn admit(&self, pixel: [u32; 2], key: u32) -> u32 {
        // Beyond the image all pixels would fall to the last block, which would then have many writers.
        let covered = |i: usize| pixel[i] < self.blocks[i] * self.block;
        debug_assert!(covered(0) && covered(1), "{pixel:?} is not in the image that the cache was made for");
        let [x, y] = self.block_of(pixel[0] as f32 + 0.5, pixel[1] as f32 + 0.5);
        for slot in self.slots_of([x as usize, y as usize]) {
            let held = self.keys[slot].load(Relaxed);
            if held == 0 {
                self.keys[slot].store(key, Relaxed);
                // Fresh memory that is read before it is written costs two page faults and all threads a pause.
                for counter in [slot * self.groups, (slot + 1) * self.groups - 1] {
                    self.counts[counter].store(0, Relaxed);
                }
            }
            if held == 0 || held == key {
                return (slot * self.groups) as u32;
            }
        }
        NO_TARGET
    }

    /// Counts one ray.
    #[inline]
    pub fn count(&self, target: u32, occluded: u8) {
        // A plain load and store: a block has one writer at a time.
        let counter = &self.counts[target as usize];
        let mut value = counter.load(Relaxed);
        if value >> 8 >= MOST {
            value = (value >> 9 << 8) | ((value & 0xff) >> 1);
        }
        counter.store(value + 0x100 + u16::from(occluded == 0), Relaxed);
    }

    /// How many slots there are, empty ones among them.
    pub fn slots(&self) -> usize {
        self.frozen.len()
    }

    /// What was frozen of a slot, in 255ths.
    #[inline]
    pub fn visibility(&self, slot: usize) -> &[u8] {
        &self.visibility[slot * self.groups..(slot + 1) * self.groups]
    }

    /// Counts look-ups for the statistics.
    pub fn tally(&self, lookups: u64, hits: u64) {
        self.lookups.fetch_add(lookups, Relaxed);
        self.hits.fetch_add(hits, Relaxed);
    }

    /// Turns what was counted into what is looked up.
    pub fn freeze(&mut self) {
        let Self { keys, counts, visibility, frozen, speaker, groups, blocks, .. } = self;
        let groups = *groups;
        for (frozen, key) in frozen.iter_mut().zip(keys.iter()) {
            *frozen = key.load(Relaxed);
        }
        let frozen = &*frozen;
        // Rows of blocks, so that regions are pieces of them side by side.
        let row = blocks[0] as usize;
        let rows = row * SLOTS * REGION;
        let taken = visibility.par_chunks_mut(rows * groups).zip(speaker.par_chunks_mut(rows));
        let pieces = taken.zip(counts.par_chunks_mut(rows * groups));
        pieces.enumerate().for_each_init(
            || Posterior::new(groups),
            |posterior, (y, ((visibility, speaker), counts))| {
                let first = y * rows;
                let count = visibility.len() / groups;
                for x in (0..row).step_by(REGION) {
                    let columns = x..(x + REGION).min(row);
                    let slots = (0..count).step_by(row).flat_map(|line| columns.clone().map(move |slot| line + slot));
                    let held = slots.filter(|slot| frozen[first + slot] != 0);
                    let member =
                        |slot: usize| (frozen[first + slot], Member::new(slot % row - x, slot / row / SLOTS, slot));
                    let mut members: Vec<(u32, Member)> = held.map(member).collect();
                    members.sort_unstable();
                    for alike in members.chunk_by(|a, b| a.0 == b.0) {
                        let alike: Vec<Member> = alike.iter().map(|&(_, member)| member).collect();
                        posterior.of(&alike, counts, Taken { visibility, speaker, first: first as u32 });
                    }
                }
            },
        );
    }

    /// Writes all that was counted and frozen, for a checkpoint.
    pub fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        let Self { groups: _, block: _, blocks: _, keys, counts, visibility, frozen, speaker, lookups, hits } = self;
        for tally in [lookups, hits] {
            out.write_all(&tally.load(Relaxed).to_ne_bytes())?;
        }
        for key in keys {
            out.write_all(&key.load(Relaxed).to_ne_bytes())?;
        }
        for count in counts {
            out.write_all(&count.load(Relaxed).to_ne_bytes())?;
        }
        out.write_all(bytemuck::cast_slice(frozen))?;
        out.write_all(bytemuck::cast_slice(speaker))?;
        out.write_all(visibility)
    }

    /// Reads what a cache of the same shape has saved.
    pub fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        for tally in [&mut self.lookups, &mut self.hits] {
            input.read_exact(bytemuck::bytes_of_mut(tally.get_mut()))?;
        }
        for key in &mut self.keys {
            input.read_exact(bytemuck::bytes_of_mut(key.get_mut()))?;
        }
        for count in &mut self.counts {
            input.read_exact(bytemuck::bytes_of_mut(count.get_mut()))?;
        }
        input.read_exact(bytemuck::cast_slice_mut(&mut self.frozen))?;
        input.read_exact(bytemuck::cast_slice_mut(&mut self.speaker))?;
        input.read_exact(&mut self.visibility)
    }

    /// Records, bytes, hit rate.
    pub fn stats(&self) -> (u64, u64, f64) {
        let records = self.keys.iter().filter(|key| key.load(Relaxed) != 0).count() as u64;
        let bytes = records * (self.groups as u64 * 3) + (self.keys.len() * (KEY_BYTES + EXPECTED_BYTES)) as u64;
        let lookups = self.lookups.load(Relaxed).max(1);
        (records, bytes, self.hits.load(Relaxed) as f64 / lookups as f64)
    }

    /// The side of a block, pixels.
    pub fn block(&self) -> u32 {
        self.block
    }
}
