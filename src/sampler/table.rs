//! Discrete distributions in integers: the widths that are drawn are the widths the density is computed from.
//!
//! Entries share 2³² counts by weight, from f64 sums, at least one count for each entry whose weight is not 0: running
//! f32 sums would never draw the dim texels of a map that has a sun in it, and so darken it. Inversion is monotone, so
//! stratified numbers stay stratified, and what is left of a number serves again inside its entry.

/// Entries with integer widths that add up to 2³².
#[derive(Debug)]
pub(super) struct Table {
    /// Where each entry starts; entries of width 0 start where the next one does.
    starts: Box<[u32]>,
    /// The last entry that starts at or before each of equally spaced numbers: where the search begins.
    guide: Box<[u32]>,
    shift: u32,
    /// The last entry that is not empty; it ends at 2³².
    last: u32,
}

/// What a number falls into.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    /// The entry.
    pub(super) index: u32,
    /// Its width, 1 to 2³².
    pub(super) width: u64,
    /// How far into it the number lies, < width.
    pub(super) rest: u32,
}

impl Found {
    /// Where in the entry the number lies, 0 to 1, with the 32 bits of `fresh` below those that are left.
    #[inline]
    pub(super) fn fraction(&self, fresh: u32) -> f64 {
        let unit = 1.0 / 4_294_967_296.0;
        (f64::from(self.rest) + (f64::from(fresh) + 0.5) * unit) / self.width as f64
    }
}

impl Table {
    /// Shares the counts by `weights` (finite, ≥ 0). `None` where all are 0.
    pub(super) fn new(weights: &[f64]) -> Option<Self> {
        let sum: f64 = weights.iter().sum();
        let last = weights.iter().rposition(|w| *w > 0.0)?;
        let entries = weights.iter().filter(|w| **w > 0.0).count();
        // One count less than there is: what rounding may add in the sums.
        let scale = ((1u64 << 32) - 1 - entries as u64) as f64 / sum;
        let (mut below, mut seen) = (0.0, 0u64);
        let starts: Box<[u32]> = weights
            .iter()
            .map(|&weight| {
                let start = (below * scale) as u64 + seen;
                below += weight;
                seen += u64::from(weight > 0.0);
                // Only the empty entries behind the last one would start beyond the end.
                start.min(u64::from(u32::MAX)) as u32
            })
            .collect();
        // A step of the guide for about four entries: a cache line of them is looked through at most as a rule.
        let steps = (weights.len() / 4).next_power_of_two().max(2);
        let shift = 32 - steps.trailing_zeros();
        let mut index = 0;
        let guide = (0..steps as u64)
            .map(|step| {
                while index < last && u64::from(starts[index + 1]) <= step << shift {
                    index += 1;
                }
                index as u32
            })
            .collect();
        Some(Self { starts, guide, shift, last: last as u32 })
    }

    /// The entry that holds `number`.
    #[inline]
    pub(super) fn find(&self, number: u32) -> Found {
        let step = (number >> self.shift) as usize;
        let mut index = self.guide[step];
        let mut bound = self.guide.get(step + 1).map_or(self.last, |next| *next);
        // Almost always a few entries; a step that holds hundreds of dim ones is halved first.
        while bound - index > 16 {
            let middle = index + (bound - index) / 2;
            if self.starts[middle as usize] <= number { index = middle } else { bound = middle }
        }
        while index < bound && self.starts[index as usize + 1] <= number {
            index += 1;
        }
        Found { index, width: self.width(index), rest: number - self.starts[index as usize] }
    }

    /// The width of an entry, 0 to 2³².
    #[inline]
    pub(super) fn width(&self, index: u32) -> u64 {
        let start = u64::from(self.starts[index as usize]);
        match index.cmp(&self.last) {
            std::cmp::Ordering::Less => u64::from(self.starts[index as usize + 1]) - start,
            std::cmp::Ordering::Equal => (1 << 32) - start,
            std::cmp::Ordering::Greater => 0,
        }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        4 * (self.starts.len() + self.guide.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::hash;

    fn check(weights: &[f64]) {
        let table = Table::new(weights).unwrap();
        let widths: Vec<u64> = (0..weights.len() as u32).map(|i| table.width(i)).collect();
        assert_eq!(widths.iter().sum::<u64>(), 1 << 32);
        let sum: f64 = weights.iter().sum();
        let mut start = 0u64;
        for (i, (&width, &weight)) in widths.iter().zip(weights).enumerate() {
            assert_eq!(width > 0, weight > 0.0, "entry {i}");
            let exact = weight / sum * 4_294_967_296.0;
            assert!((width as f64 - exact).abs() <= 4.0 + weights.len() as f64 * weight / sum, "{width} {exact}");
            // Both ends of the entry belong to it.
            if width > 0 {
                for (number, rest) in [(start, 0), (start + width - 1, width - 1)] {
                    let found = table.find(number as u32);
                    assert_eq!(found, Found { index: i as u32, width, rest: rest as u32 });
                    assert!((0.0..=1.0).contains(&found.fraction(u32::MAX)));
                }
            }
            start += width;
        }
    }

    #[test]
    fn every_entry_is_found_at_both_its_ends() {
        check(&[1.0]);
        check(&[0.0, 0.0, 3.0, 0.0]);
        check(&[1e-30, 1e30, 1e-30, 0.0, 1e-300]);
        for seed in 0..50 {
            let random = |i| f64::from(hash(&[seed, i]));
            let weights: Vec<f64> = (0..1 + hash(&[seed]) % 2000)
                .map(|i| if random(i) < 2e9 { 0.0 } else { (random(i) * 1e-8).powi(seed as i32 % 20) })
                .chain([1.0, 0.0])
                .collect();
            check(&weights);
        }
        assert!(Table::new(&[0.0, 0.0]).is_none());
    }
}
