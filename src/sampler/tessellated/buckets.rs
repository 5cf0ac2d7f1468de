//! From a group's count to the cell that holds it, by one line of memory.
//!
//! A group's counts are cut into equal buckets. The cells that have a part in a bucket, fifteen in the mean, stand in one line:
//! where the first one is along the curve, and where the counts of each begin, as far as the first cell beyond.
//! Domes are larger than caches: a search through the CDF itself waits for memory at every other step.

use super::pages::Row;
use crate::simd::prefetch;
use bytemuck::{Pod, Zeroable};
use std::hint::select_unpredictable;

/// A bucket's counts: so many bits.
const BITS: u32 = 16;

/// Cells to a bucket, about: some have more than others.
const CELLS_A_BUCKET: usize = 14;

/// Cells that can begin in a bucket, and the steps that find one of them.
const ROOM: usize = 23;
const STEPS: [usize; 5] = [8, 8, 4, 2, 1];

/// The cells of a bucket.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line {
    /// Where the cell that holds the bucket's first count is along the curve, and where its counts begin.
    place: u32,
    begin: u32,
    /// Where those of the first cell beyond the bucket begin; [`CROWDED`]: the place of the last cell inside.
    end: u32,
    /// How many cells begin in the bucket, the first one not counted; or [`CROWDED`].
    count: u16,
    /// Where they do, from the bucket's beginning on.
    begins: [u16; ROOM],
    unused: [u16; 2],
}

/// A line has no room for all of its cells.
const CROWDED: u16 = u16::MAX;

/// What keeps a group's counts below 2³¹.
const MOST_BUCKETS: usize = (1 << (31 - BITS)) - 1;

/// A group's lines.
#[derive(Debug, Clone, Copy)]
struct Lines {
    first: u32,
    count: u32,
}

/// The buckets of all groups.
#[derive(Debug)]
pub(super) struct Buckets {
    lines: Row<Line>,
    /// By the group's slot.
    groups: Vec<Lines>,
}

/// A cell that a count falls to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found {
    /// Along the curve.
    pub(super) place: u32,
    /// Where its counts begin in its group's, and how many they are.
    pub(super) begin: u32,
    pub(super) width: u32,
}

impl Buckets {
    /// Room for groups of so many cells each.
    pub(super) fn new(cells: impl Iterator<Item = usize>) -> Self {
        let mut first = 0;
        let groups: Vec<Lines> = cells
            .map(|cells| {
                let count = cells.div_ceil(CELLS_A_BUCKET).clamp(1, MOST_BUCKETS) as u32;
                let lines = Lines { first, count };
                first += lines.count;
                lines
            })
            .collect();
        Self { lines: Row::new(first as usize), groups }
    }

    /// The room of each group, to be filled.
    pub(super) fn rooms(&mut self) -> impl Iterator<Item = Room<'_>> {
        let mut rest = self.lines.get_mut();
        self.groups.iter().map(move |of_group| {
            let lines = rest.split_off_mut(..of_group.count as usize).expect("as many as all groups have");
            Room { lines }
        })
    }

    /// All counts of a group.
    #[inline(always)]
    pub(super) fn counts(&self, group: u32) -> u32 {
        self.groups[group as usize].count << BITS
    }

    /// The line of a group's count `at`, which memory is asked for.
    #[inline(always)]
    pub(super) fn ask_for(&self, group: u32, at: u32) -> u32 {
        let line = self.groups[group as usize].first + (at >> BITS);
        prefetch(self.lines.get(), line as usize);
        line
    }

    /// The cell in a line that count `at` of its group falls to. `begins` are those of all cells, 0 where a group's begin.
    #[inline(always)]
    pub(super) fn find(&self, line: u32, at: u32, begins: &[u32]) -> Found {
        let line = &self.lines.get()[line as usize];
        if line.count == CROWDED {
            return line.search(at, begins);
        }
        let within = at as u16;
        let begun = line.begun(within).min(line.count);
        let of = |i: u16| at & !u32::from(u16::MAX) | u32::from(line.begins[i as usize % ROOM]);
        let begin = if begun > 0 { of(begun - 1) } else { line.begin };
        let end = if begun < line.count { of(begun) } else { line.end };
        Found { place: line.place + u32::from(begun), begin, width: end - begin }
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(self.lines.get()) + size_of_val(&self.groups[..])
    }
}

/// The lines of a group.
pub(super) struct Room<'a> {
    lines: &'a mut [Line],
}

impl Room<'_> {
    /// The counts that the group's cells must share out.
    pub(super) fn counts(&self) -> u32 {
        (self.lines.len() as u32) << BITS
    }

    /// Fills them: the group's first cell is at `place`, its cells' counts begin at `begins`.
    pub(super) fn fill(self, place: u32, begins: &[u32]) {
        let all = self.counts();
        let mut first = 0;
        for (line, from) in self.lines.iter_mut().zip((0..).step_by(1 << BITS)) {
            while begins.get(first + 1).is_some_and(|&next| next <= from) {
                first += 1;
            }
            let next = &begins[first + 1..];
            let is_inside = |begin: &u32| begin - from < 1 << BITS;
            let inside = next.iter().take(ROOM + 1).take_while(|begin| is_inside(begin)).count();
            *line = Line { place: place + first as u32, begin: begins[first], ..Line::zeroed() };
            if inside <= ROOM {
                (line.count, line.end) = (inside as u16, *next.get(inside).unwrap_or(&all));
                line.begins = [u16::MAX; ROOM];
                line.begins.iter_mut().zip(&next[..inside]).for_each(|(to, &begin)| *to = (begin - from) as u16);
            } else {
                (line.count, line.end) = (CROWDED, line.place + next.partition_point(is_inside) as u32);
            }
        }
    }
}

impl Line {
    /// How many have begun at a count of the bucket's; those that there are, and more for the last count of all.
    #[inline(always)]
    fn begun(&self, within: u16) -> u16 {
        let mut begun = 0;
        for step in STEPS {
            let next = begun + step;
            begun = select_unpredictable(self.begins[next - 1] <= within, next, begun);
        }
        begun as u16
    }

    /// The cell that count `at` falls to, among all of the group's.
    #[cold]
    fn search(&self, at: u32, begins: &[u32]) -> Found {
        let (mut place, mut size) = (self.place, self.end - self.place + 1);
        while size > 1 {
            // No branch: which way it goes is a coin's toss.
            let next = place + size / 2;
            place = select_unpredictable(begins[next as usize] <= at, next, place);
            size -= size / 2;
        }
        let (begin, next) = (begins[place as usize], begins[place as usize + 1]);
        // The next group's begin at 0 again.
        let end = if next > begin { next } else { (at | u32::from(u16::MAX)) + 1 };
        Found { place, begin, width: end - begin }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    /// Groups of one cell and of many, of equal cells and of a bright one among crowds of dim ones.
    #[test]
    fn every_count_falls_to_its_cell() {
        let sizes = [1, 2, 20, 100, 5000].into_iter().flat_map(|cells| [false, true].map(|bright| (cells, bright)));
        let mut buckets = Buckets::new(sizes.clone().map(|(cells, _)| cells));
        let counts = |i: usize| buckets.counts(i as u32);
        let groups: Vec<Vec<u32>> = sizes
            .enumerate()
            .map(|(i, (cells, bright))| {
                let even = counts(i) / cells as u32;
                let width = |cell: usize| if bright { 1 + cell as u32 % 3 } else { even };
                let mut at = 0;
                let mut begin = |cell| {
                    at += width(cell);
                    at - width(cell)
                };
                let mut begins: Vec<u32> = (0..cells).map(&mut begin).collect();
                // What is left is the middle one's.
                begins[cells / 2 + 1..].iter_mut().for_each(|begin| *begin += counts(i) - at);
                begins
            })
            .collect();
        let begins: Vec<u32> = groups.iter().flatten().copied().chain([0]).collect();
        let mut place = 0;
        for (room, of_group) in buckets.rooms().zip(&groups) {
            room.fill(place, of_group);
            place += of_group.len() as u32;
        }
        let crowded = buckets.lines.get().iter().filter(|line| line.count == CROWDED).count();
        assert!((1..buckets.lines.get().len() / 2).contains(&crowded), "both kinds are tried: {crowded}");
        let mut first = 0;
        for (group, of_group) in groups.iter().enumerate() {
            let all = buckets.counts(group as u32);
            let edges = of_group.iter().flat_map(|&begin| [begin.saturating_sub(1), begin, begin + 1]);
            let ends = (0..all).step_by(1 << BITS).flat_map(|begin| [begin, begin + u32::from(u16::MAX)]);
            let anywhere = (0..1000).map(|i| random::hash(&[i]) % all);
            for at in edges.chain(ends).chain(anywhere).filter(|at| *at < all) {
                let cell = of_group.partition_point(|&begin| begin <= at) - 1;
                let (begin, end) = (of_group[cell], of_group.get(cell + 1).unwrap_or(&all));
                let expected = Found { place: first + cell as u32, begin, width: end - begin };
                assert_eq!(buckets.find(buckets.ask_for(group as u32, at), at, &begins), expected, "{group}: {at}");
            }
            first += of_group.len() as u32;
        }
    }
}
