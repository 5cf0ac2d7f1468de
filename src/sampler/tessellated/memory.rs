//! The shadow cache as a sampler lives with it: cold in the first stage, frozen within each later one.

use crate::random;
use crate::sampler::shadow_cache::{NO_TARGET, Record, ShadowCache};
use crate::sampler::{CacheStats, Draws, Point};
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// A cache, if there is one, whether it has anything to say, and whether it takes anything in.
#[derive(Debug)]
pub(super) struct Memory {
    cache: Option<ShadowCache>,
    warm: bool,
    listens: bool,
    version: u64,
}

/// The record read last: samples of a pixel mostly read the same one.
#[derive(Debug, Default)]
pub struct Found {
    version: u64,
    seed: u32,
    pixel: [u32; 2],
    key: u32,
    slot: Option<u32>,
}

/// A number that was not given out before; never 0.
fn next_version() -> u64 {
    static LAST: AtomicU64 = AtomicU64::new(0);
    LAST.fetch_add(1, Relaxed) + 1
}

/// How far a pixel's look-up is moved: across and down, in blocks, and along the distance; each in [−½, ½).
fn jitter(seed: u32) -> [f32; 3] {
    let jitter = random::combine(seed, 0x5ad0);
    [jitter, random::mix(jitter), random::mix(jitter ^ 0x9e37_79b9)].map(|word| random::unit(word) - 0.5)
}

impl Memory {
    pub(super) fn new(cache: Option<ShadowCache>) -> Self {
        let listens = cache.is_some();
        Self { cache, warm: false, listens, version: next_version() }
    }

    /// Never the same for two samplers or two stages: what was made for another is made anew.
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    pub(super) fn cache(&self) -> Option<&ShadowCache> {
        self.cache.as_ref()
    }

    /// Counts what rays see from now on, or does not.
    pub(super) fn listen(&mut self, on: bool) {
        self.listens = on && self.cache.is_some();
    }

    /// Whether rays are counted.
    pub(super) fn listens(&self) -> bool {
        self.listens
    }

    /// Whether a stage has ended.
    pub(super) fn is_warm(&self) -> bool {
        self.warm
    }

    /// The record that a point reads. One look-up's jitter a pixel: its samples then share their weights.
    pub(super) fn read(&self, point: &Point, last: &mut Found) -> Option<Record<'_>> {
        let cache = self.cache.as_ref().filter(|_| self.warm)?;
        let (pixel, seed) = (point.pixel, point.numbers.seed);
        let [a, b, c] = jitter(seed);
        let key = ShadowCache::key(point.ng, point.distance, c);
        if (last.version, last.seed, last.pixel, last.key) != (self.version, seed, pixel, key) {
            let slot = cache.find(pixel, key, [a, b]);
            *last = Found { version: self.version, seed, pixel, key, slot };
        }
        last.slot.map(|slot| Record { slot, visibility: cache.visibility(slot as usize) })
    }

    /// What a record that was read says of the groups, in 255ths.
    pub(super) fn visibility(&self, slot: u32) -> &[u8] {
        let cache = self.cache.as_ref().expect("records come from a cache");
        cache.visibility(slot as usize)
    }

    /// Where a point's rays are counted, while they are.
    pub(super) fn target(&self, point: &Point) -> Option<u32> {
        let cache = self.cache.as_ref().filter(|_| self.listens)?;
        Some(cache.admit(point.pixel, ShadowCache::key(point.ng, point.distance, 0.0)))
    }

    /// The record a point reads, and the target its rays are counted towards, if any.
    pub(super) fn consult(&self, point: &Point, out: &mut Draws) -> (Option<Record<'_>>, u32) {
        if self.cache.is_none() {
            return (None, NO_TARGET);
        }
        let target = self.target(point).unwrap_or(NO_TARGET);
        let record = self.read(point, &mut out.prepared.found);
        out.lookups += u64::from(self.warm);
        out.found += u64::from(record.is_some());
        (record, target)
    }

    pub(super) fn observe(&self, targets: &[u32], occluded: &[u8]) {
        if let Some(cache) = &self.cache {
            for (&target, &occluded) in targets.iter().zip(occluded) {
                if target != NO_TARGET {
                    cache.count(target, occluded);
                }
            }
        }
    }

    /// Ends a stage.
    pub(super) fn freeze(&mut self) {
        if let Some(cache) = &mut self.cache {
            cache.freeze();
            self.warm = true;
            self.version = next_version();
        }
    }

    pub(super) fn save(&self, out: &mut dyn Write) -> io::Result<()> {
        let Some(cache) = &self.cache else { return Ok(()) };
        out.write_all(&[self.warm.into()])?;
        cache.save(out)
    }

    pub(super) fn restore(&mut self, input: &mut dyn Read) -> io::Result<()> {
        let Some(cache) = &mut self.cache else { return Ok(()) };
        let mut warm = [0];
        input.read_exact(&mut warm)?;
        self.warm = warm != [0];
        self.version = next_version();
        cache.restore(input)
    }

    /// Takes over what `draws` counted.
    pub(super) fn tally(&self, draws: &mut Draws) {
        if let Some(cache) = &self.cache {
            cache.tally(draws.lookups, draws.found);
            (draws.lookups, draws.found) = (0, 0);
        }
    }

    /// The block that a pixel's look-up falls to.
    pub(super) fn place(&self, pixel: [u32; 2], seed: u32) -> u32 {
        let [a, b, _] = jitter(seed);
        self.cache.as_ref().map_or(0, |cache| cache.place(pixel, [a, b]))
    }

    pub(super) fn tile_multiple(&self) -> u32 {
        self.cache.as_ref().map_or(1, ShadowCache::block)
    }

    pub(super) fn stats(&self) -> Option<CacheStats> {
        self.cache.as_ref().map(|cache| {
            let (records, bytes, hit_rate) = cache.stats();
            CacheStats { records, bytes, hit_rate }
        })
    }
}
