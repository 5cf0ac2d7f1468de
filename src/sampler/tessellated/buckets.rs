//! From a group's count to the cell that holds it, by one line of memory.
//!
//! A group's counts are cut into equal buckets. The cells that have a part in a bucket, eleven or so, stand in one
//! line: where the first one is along the curve, and where the counts of each begin, as far as the first cell beyond.
//! Domes are larger than caches: a search through the CDF itself waits for memory at every other step.

use super::lanes;
use super::texels::COUNTS;
use crate::pages::Pages;
use crate::simd::prefetch;
use bytemuck::{Pod, Zeroable};
use std::hint::select_unpredictable;

/// A line of memory: the first cell's place, then beginnings, then [`NONE`].
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Line(pub(super) [u32; 16]);

/// Cells to a bucket, about. (With eight a 4096×2048 dome takes 13 MB more for no more speed.)
const CELLS_A_BUCKET: usize = 10;

/// Set with the place where a line has no room for all of its cells: what follows is the last one's place.
const CROWDED: u32 = 1 << 31;

/// So many cells of a crowded line, which is most often all, are looked through at once.
pub(super) const CROWD: usize = 32;

/// More than any count.
const NONE: u32 = u32::MAX;

/// A group's lines.
#[derive(Debug, Clone, Copy)]
struct Lines {
    first: u32,
    count: u32,
}

impl Lines {
    /// The line of a count.
    #[inline(always)]
    fn of(self, at: u32) -> u32 {
        self.first + (u64::from(at) * u64::from(self.count) / u64::from(COUNTS)) as u32
    }

    /// The first count of the `i`-th line.
    fn begin(self, i: usize) -> u32 {
        (i as u64 * u64::from(COUNTS)).div_ceil(u64::from(self.count)) as u32
    }
}

/// The buckets of all groups.
#[derive(Debug)]
pub(super) struct Buckets {
    lines: Pages<Line>,
    /// By the group's slot.
    groups: Vec<Lines>,
}

/// A cell that a count falls to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found {
    /// Along the curve.
    pub(super) place: u32,
    /// How far the count lies beyond the cell's first, and how many the cell has.
    pub(super) offset: u32,
    pub(super) width: u32,
}

impl Buckets {
    /// Room for groups of so many cells each.
    pub(super) fn new(cells: impl Iterator<Item = usize>) -> Self {
        let mut first = 0;
        let groups: Vec<Lines> = cells
            .map(|cells| {
                let lines = Lines { first, count: cells.div_ceil(CELLS_A_BUCKET).max(1) as u32 };
                first += lines.count;
                lines
            })
            .collect();
        Self { lines: Pages::zeroed(first as usize), groups }
    }

    /// The room of each group, to be filled.
    pub(super) fn rooms(&mut self) -> impl Iterator<Item = Room<'_>> {
        let mut rest = &mut self.lines[..];
        self.groups.iter().map(move |&of_group| {
            let lines = rest.split_off_mut(..of_group.count as usize).expect("as many as all groups have");
            Room { of_group, lines }
        })
    }

    /// To look counts up in.
    #[inline(always)]
    pub(super) fn view(&self) -> View<'_> {
        View { lines: &self.lines, groups: &self.groups }
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.lines[..]) + size_of_val(&self.groups[..])
    }
}

/// The buckets, for a block of look-ups.
#[derive(Debug, Clone, Copy)]
pub(super) struct View<'a> {
    lines: &'a [Line],
    groups: &'a [Lines],
}

impl View<'_> {
    /// The line of a group's count `at`, which memory is asked for.
    #[inline(always)]
    pub(super) fn ask_for(&self, group: u32, at: u32) -> u32 {
        let line = self.groups[group as usize].of(at);
        prefetch(self.lines, line as usize);
        line
    }

    /// Which beginning in its line is the last that does not exceed a count `at`, for each of a block.
    #[inline(always)]
    pub(super) fn begun<const N: usize>(&self, line: &[u32], at: &[u32; N]) -> [u32; N] {
        lanes::begun(self.lines, line, at)
    }

    /// Whether a line has no room for all of its cells.
    #[inline(always)]
    pub(super) fn is_crowded(&self, line: u32) -> bool {
        let Line(line) = &self.lines[line as usize];
        line[0] & CROWDED != 0
    }

    /// The cell in a line that count `at` of its group falls to, where `begun` is the last beginning that does not
    /// exceed it. Of a crowded line it says nothing of worth.
    #[inline(always)]
    pub(super) fn cell(&self, line: u32, begun: u32, at: u32) -> Found {
        let Line(line) = &self.lines[line as usize];
        let (begin, end) = (line[begun as usize % line.len()], line[(begun as usize + 1) % line.len()]);
        let place = line[0].wrapping_add(begun).wrapping_sub(1);
        Found { place, offset: at.wrapping_sub(begin), width: end.wrapping_sub(begin) }
    }

    /// Asks memory for the beginnings of a crowded line's cells.
    #[inline(always)]
    pub(super) fn ask_for_crowd(&self, line: u32, begins: &[u32]) {
        let [low, high] = self.crowd(line);
        let size = high - low + 1;
        // Where a search goes first, or all that it reads.
        let from = if size > CROWD as u32 { low + size / 2 } else { low };
        prefetch(begins, from as usize);
        prefetch(begins, from as usize + CROWD / 2);
    }

    /// The cell in a crowded line that count `at` of its group falls to. `begins` are those of all cells, and [`CROWD`]
    /// more.
    #[inline(always)]
    pub(super) fn cell_in_crowd(&self, line: u32, at: u32, begins: &[u32]) -> Found {
        let place = search(begins, self.crowd(line), at);
        let (begin, width) = counts(begins, place);
        Found { place, offset: at - begin, width }
    }

    /// The first and the last cell of a crowded line.
    #[inline(always)]
    fn crowd(&self, line: u32) -> [u32; 2] {
        let Line(line) = &self.lines[line as usize];
        [line[0] & !CROWDED, line[1]]
    }
}

/// The lines of a group.
pub(super) struct Room<'a> {
    of_group: Lines,
    lines: &'a mut [Line],
}

impl Room<'_> {
    /// Fills them: the group's first cell is at `place`, its cells' counts begin at `begins`.
    pub(super) fn fill(self, place: u32, begins: &[u32]) {
        let Self { of_group, lines } = self;
        let mut first = 0;
        for (i, Line(line)) in lines.iter_mut().enumerate() {
            let (from, to) = (of_group.begin(i), of_group.begin(i + 1));
            while begins.get(first + 1).is_some_and(|&next| next <= from) {
                first += 1;
            }
            let count = begins[first..].iter().take(line.len()).take_while(|&&begin| begin < to).count();
            *line = [NONE; 16];
            line[0] = place + first as u32;
            // The beginnings, and where the next cell begins.
            if count + 2 <= line.len() {
                line[1..=count].copy_from_slice(&begins[first..first + count]);
                line[count + 1] = *begins.get(first + count).unwrap_or(&COUNTS);
            } else {
                let beyond = begins[first..].partition_point(|&begin| begin < to);
                line[0] |= CROWDED;
                line[1] = place + (first + beyond) as u32 - 1;
            }
        }
    }
}

/// Where a cell's counts begin in its group's, and how many they are.
#[inline(always)]
pub(super) fn counts(begins: &[u32], place: u32) -> (u32, u32) {
    let (begin, next) = (begins[place as usize], begins[place as usize + 1]);
    // The next group's begin at 0 again.
    let end = if next > begin { next } else { COUNTS };
    (begin, end - begin)
}

/// The place between two that count `at` of their group falls to.
#[inline(always)]
fn search(begins: &[u32], [low, high]: [u32; 2], at: u32) -> u32 {
    let (mut low, mut size) = (low, high - low + 1);
    while size > CROWD as u32 {
        // No branch: which way it goes is a coin's toss.
        let next = low + size / 2;
        low = select_unpredictable(begins[next as usize] <= at, next, low);
        size -= size / 2;
    }
    // No beginning waits for another.
    let mut begun = [0; CROWD];
    begun.copy_from_slice(&begins[low as usize..][..CROWD]);
    for (i, begun) in (0..).zip(&mut begun) {
        *begun = u32::from((*begun <= at) & (i < size));
    }
    low + begun.into_iter().sum::<u32>() - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    /// Groups of one cell and of many, of equal cells and of a bright one among crowds of dim ones.
    #[test]
    fn every_count_falls_to_its_cell() {
        let groups: Vec<Vec<u32>> = [1, 2, 9, 100, 5000]
            .into_iter()
            .flat_map(|cells| [false, true].map(|bright| (cells, bright)))
            .map(|(cells, bright)| {
                let width = |i: u32| if bright { 1 + i % 3 } else { COUNTS / cells };
                let mut begins: Vec<u32> =
                    (0..cells).scan(0, |at, i| Some(std::mem::replace(at, *at + width(i)))).collect();
                // What is left is the middle one's.
                let left = COUNTS - begins[cells as usize - 1] - width(cells - 1);
                begins[cells as usize / 2 + 1..].iter_mut().for_each(|begin| *begin += left);
                begins
            })
            .collect();
        let begins: Vec<u32> = groups.iter().flatten().copied().chain([0; CROWD]).collect();
        let mut buckets = Buckets::new(groups.iter().map(Vec::len));
        let mut place = 0;
        for (room, of_group) in buckets.rooms().zip(&groups) {
            room.fill(place, of_group);
            place += of_group.len() as u32;
        }
        let crowded = buckets.lines.iter().filter(|Line(line)| line[0] & CROWDED != 0).count();
        assert!((1..buckets.lines.len() / 2).contains(&crowded), "both kinds are tried: {crowded}");
        let mut first = 0;
        let buckets = buckets.view();
        for (group, of_group) in groups.iter().enumerate() {
            let edges = of_group.iter().flat_map(|&begin| [begin.saturating_sub(1), begin, begin + 1]);
            let anywhere = (0..1000).map(|i| random::hash(&[i]) / 2);
            for at in edges.chain(anywhere).chain([COUNTS - 1]).filter(|at| *at < COUNTS) {
                let cell = of_group.partition_point(|&begin| begin <= at) - 1;
                let end = of_group.get(cell + 1).unwrap_or(&COUNTS);
                let begin = of_group[cell];
                let expected = Found { place: first + cell as u32, offset: at - begin, width: end - begin };
                let line = buckets.ask_for(group as u32, at);
                let begun = buckets.begun(&[line], &[at])[0];
                let found = match buckets.is_crowded(line) {
                    true => buckets.cell_in_crowd(line, at, &begins),
                    false => buckets.cell(line, begun, at),
                };
                assert_eq!(found, expected, "{group}: {at}");
            }
            first += of_group.len() as u32;
        }
    }
}
