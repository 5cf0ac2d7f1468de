//! The dome cut into spherical triangles: a cube's faces along their diagonals, then halved and halved again where it
//! pays.
//!
//! Halving a right-angled triangle at its longest side gives two of the same shape, and sizes a factor of two apart:
//! with four-way splits of an icosahedron a fixed number of triangles leaves some four times as large as others. Splitting is greedy by a priority of energy and solid angle. It runs twice: first into *groups*, the cells of which
//! the shadow cache knows the visibility, then every group into its *leaves*, inside which the cosine hardly changes.
//! Each cell of the image belongs to the leaf its centre lies in, so that leaves partition the cells exactly, whatever
//! the rounding. Triangles follow one continuous curve over the sphere (a child's curve enters where its predecessor's
//! ended): neighbours along the curve are neighbours on the dome, so one stratified number stratifies directions.

use bytemuck::Zeroable;
use glam::{DQuat, DVec3, EulerRot, Vec3};
use rayon::prelude::*;
use std::collections::BinaryHeap;
use std::ops::Range;

/// The most leaves a group may have.
pub const LEAVES_A_GROUP: usize = 48;

/// How deep triangles are split at most; a triangle of that level is 1e-4 rad across, below a texel of any dome.
const DEEPEST: u32 = 28;

/// The image's cells as the tessellation sees them.
pub trait Cells: Sync {
    /// How many there are.
    fn count(&self) -> usize;
    /// The direction of a cell's centre.
    fn center(&self, cell: u32) -> DVec3;
    /// Its energy: scalar weight × solid angle; 0 for a black cell, which no triangle takes.
    fn energy(&self, cell: u32) -> f64;
    /// Its solid angle, steradians.
    fn solid_angle(&self, cell: u32) -> f64;
}

/// A finished tessellation.
#[derive(Debug, Default)]
pub struct Tessellation {
    /// Lit cells, leaf by leaf along the curve.
    pub cells: Vec<u32>,
    /// The cells of each leaf as a range of `cells`, group by group.
    pub leaves: Vec<Range<usize>>,
    /// The leaves of each group as a range of `leaves`.
    pub groups: Vec<Range<usize>>,
    /// Corners of each leaf.
    pub corners: Vec<[DVec3; 3]>,
}

/// A lit cell on its way down: with what every split asks for.
#[derive(Debug, Clone, Copy, Zeroable)]
struct Lit {
    cell: u32,
    center: Vec3,
    /// Of the whole image's energy: in single precision whatever the image's unit.
    share: f32,
}

/// Lit cells sorted into triangles, and the energy of all of them.
struct Sorted {
    cells: Vec<Lit>,
    energy: f64,
}

#[derive(Debug, Clone)]
struct Node {
    /// Where the curve enters, the corner it passes by, where it leaves.
    corners: [DVec3; 3],
    cells: Range<usize>,
    energy: f64,
    /// ∫ of the weight's square over it, where a tessellation goes by contrast; else 0.
    square: f64,
    depth: u32,
    group: usize,
}

struct Queued {
    priority: f64,
    node: usize,
}

impl PartialEq for Queued {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}
impl Eq for Queued {}
impl PartialOrd for Queued {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Queued {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        // Ties by index, so that the tessellation is a function of the dome alone.
        self.priority.total_cmp(&other.priority).then(other.node.cmp(&self.node))
    }
}

impl Tessellation {
    /// Cuts the dome into at most `groups` groups and `triangles` leaves.
    pub fn new(cells: &impl Cells, groups: usize, triangles: usize) -> Self {
        let (Sorted { cells: mut order, energy: total }, faces) = sort_into_faces(cells);
        let mut scratch = Vec::new();

        // Groups: a cell of the cache must be small where the light is, but darkness, too, wants its share: what lies
        // in the sun's shadow is lit by the rest.
        let group_priority = |node: &Node| (node.energy / total).sqrt() * solid_angle(node).sqrt();
        let grow = Grow { cells, total, scratch: &mut scratch, order: &mut order, covering: false };
        let mut nodes = grow.run(faces, groups, usize::MAX, group_priority);
        for (i, node) in nodes.iter_mut().enumerate() {
            node.group = i;
        }

        // Leaves: the cosine's variance inside a triangle goes with its solid angle.
        let leaf_priority = |node: &Node| (node.energy / total).sqrt() * solid_angle(node);
        let nodes = if triangles < nodes.len() * LEAVES_A_GROUP {
            let grow = Grow { cells, total, scratch: &mut scratch, order: &mut order, covering: false };
            grow.run(nodes, triangles, LEAVES_A_GROUP, leaf_priority)
        } else {
            // As many as fit: no group's take from another's.
            let alone = |(node, order): (Node, &mut [Lit])| {
                let (begin, group) = (node.cells.start, node.group);
                let root = Node { cells: 0..order.len(), group: 0, ..node };
                let grow = Grow { cells, total, scratch: &mut Vec::new(), order, covering: false };
                let mut leaves = grow.run(vec![root], LEAVES_A_GROUP, LEAVES_A_GROUP, leaf_priority);
                for leaf in &mut leaves {
                    leaf.cells = begin + leaf.cells.start..begin + leaf.cells.end;
                    leaf.group = group;
                }
                leaves
            };
            let parts = apart(&nodes, &mut order);
            nodes.into_par_iter().zip(parts).flat_map_iter(alone).collect()
        };
        Self::of(nodes, order)
    }

    /// Covers the whole sphere with at most `triangles` triangles, each its own group. Every cell must have light.
    pub fn covering(cells: &impl Cells, triangles: usize) -> Self {
        let (Sorted { cells: mut order, energy: total }, mut faces) = sort_into_faces(cells);
        for face in &mut faces {
            face.square = order[face.cells.clone()].iter().map(|lit| square(cells, lit.cell)).sum();
        }
        // A direction uniform in a triangle: what its light's contrast and its cosine's change add to the estimate's spread.
        let priority = |node: &Node| {
            let solid_angle = solid_angle(node);
            (solid_angle * node.square).sqrt() - node.energy * (1.0 - 0.1 * solid_angle)
        };
        let grow = Grow { cells, total, scratch: &mut Vec::new(), order: &mut order, covering: true };
        let mut nodes = grow.run(faces, triangles, usize::MAX, priority);
        for (i, node) in nodes.iter_mut().enumerate() {
            node.group = i;
        }
        Self::of(nodes, order)
    }

    fn of(nodes: Vec<Node>, order: Vec<Lit>) -> Self {
        let mut result = Self { cells: order.par_iter().map(|lit| lit.cell).collect(), ..Self::default() };
        drop(order);
        for node in nodes {
            if result.groups.len() <= node.group {
                result.groups.push(result.leaves.len()..result.leaves.len());
            }
            result.leaves.push(node.cells);
            result.corners.push(node.corners);
            let last = result.groups.len() - 1;
            result.groups[last].end += 1;
        }
        result
    }
}

/// Each node's cells.
fn apart<'a>(nodes: &[Node], mut order: &'a mut [Lit]) -> Vec<&'a mut [Lit]> {
    let cut = |node: &Node| order.split_off_mut(..node.cells.len()).expect("nodes along the curve share all cells");
    nodes.iter().map(cut).collect()
}

struct Grow<'a, C> {
    cells: &'a C,
    /// The energy of all cells.
    total: f64,
    order: &'a mut [Lit],
    scratch: &'a mut Vec<Lit>,
    /// Whether every part of the sphere is to stay in a triangle: then none is split off that holds no cell's centre.
    covering: bool,
}

impl<C: Cells> Grow<'_, C> {
    /// Splits until there are `most` triangles or none that can be split, no group getting more than `most_a_group`;
    /// returns the leaves along the curve.
    fn run(mut self, start: Vec<Node>, most: usize, most_a_group: usize, priority: impl Fn(&Node) -> f64) -> Vec<Node> {
        let mut in_group = vec![0usize; start.len()];
        let mut next: Vec<Option<[Option<usize>; 2]>> = vec![None; start.len()];
        let mut nodes = start;
        let roots = nodes.len();
        let mut heap: BinaryHeap<_> =
            (0..roots).map(|node| Queued { priority: priority(&nodes[node]), node }).collect();
        for node in &nodes {
            in_group[node.group] += 1;
        }
        let mut count = roots;
        while count < most {
            let Some(Queued { node, .. }) = heap.pop() else { break };
            let group = nodes[node].group;
            if nodes[node].cells.len() < 2 || nodes[node].depth >= DEEPEST || in_group[group] >= most_a_group {
                continue;
            }
            let parent = nodes[node].clone();
            let halves = self.split(&parent);
            if self.covering && halves.iter().any(|half| half.cells.is_empty()) {
                continue;
            }
            let mut slots = [None; 2];
            for (slot, child) in slots.iter_mut().zip(halves) {
                if !child.cells.is_empty() {
                    *slot = Some(nodes.len());
                    heap.push(Queued { priority: priority(&child), node: nodes.len() });
                    nodes.push(child);
                    next.push(None);
                    count += 1;
                    in_group[group] += 1;
                }
            }
            count -= 1;
            in_group[group] -= 1;
            next[node] = Some(slots);
        }
        // Leaves in the curve's order: depth first over the splits.
        let mut leaves = Vec::with_capacity(count);
        let mut stack: Vec<usize> = (0..roots).rev().collect();
        while let Some(node) = stack.pop() {
            match &next[node] {
                Some(slots) => stack.extend(slots.iter().rev().flatten()),
                None => leaves.push(nodes[node].clone()),
            }
        }
        leaves
    }

    /// The two halves of a triangle in the curve's order, the parent's cells sorted into them in place.
    fn split(&mut self, parent: &Node) -> [Node; 2] {
        let [entry, by, exit] = parent.corners;
        let middle = (entry + exit).normalize();
        let corners = [[entry, middle, by], [by, middle, exit]];
        // The plane of the cut, positive on the entry's side.
        let normal = by.cross(middle);
        let normal = if normal.dot(entry) < 0.0 { -normal } else { normal }.as_vec3();
        let own = &mut self.order[parent.cells.clone()];
        self.scratch.clear();
        // Sums of their own, not rows of two: those would go through memory with every cell.
        let (mut before, mut behind, mut squares) = (0.0, 0.0, [0.0; 2]);
        let mut kept = 0;
        for i in 0..own.len() {
            let lit = own[i];
            let half = usize::from(lit.center.dot(normal) <= 0.0);
            if parent.square > 0.0 {
                squares[half] += square(self.cells, lit.cell);
            }
            if half == 0 {
                before += f64::from(lit.share);
                own[kept] = lit;
                kept += 1;
            } else {
                behind += f64::from(lit.share);
                self.scratch.push(lit);
            }
        }
        let shares = [before, behind];
        own[kept..].copy_from_slice(self.scratch);
        let Range { start, end } = parent.cells;
        let halves = [start..start + kept, start + kept..end];
        let mut halves = halves.into_iter();
        std::array::from_fn(|i| Node {
            corners: corners[i],
            cells: halves.next().expect("there are two halves"),
            energy: shares[i] * self.total,
            square: squares[i],
            depth: parent.depth + 1,
            group: parent.group,
        })
    }
}

/// ∫ of the weight's square over a cell.
fn square(cells: &impl Cells, cell: u32) -> f64 {
    cells.energy(cell).powi(2) / cells.solid_angle(cell)
}

fn solid_angle(node: &Node) -> f64 {
    spherical_area(node.corners)
}

/// The solid angle of a spherical triangle (Van Oosterom & Strackee 1983: exact at every size).
pub fn spherical_area([a, b, c]: [DVec3; 3]) -> f64 {
    // The triple product from edge vectors: a·(b × c) cancels for small triangles.
    let triple = a.dot((b - a).cross(c - a));
    2.0 * triple.abs().atan2(1.0 + a.dot(b) + b.dot(c) + c.dot(a))
}

/// Lit cells sorted into the cube's twelve triangles, along the curve.
fn sort_into_faces(cells: &impl Cells) -> (Sorted, Vec<Node>) {
    const TRIANGLES: usize = 12;
    const PORTION: usize = 1 << 14;
    let path = cube_path();
    let middle = |i: usize| path[i][0] + path[i][2];
    // A face: its middle, its diagonal's plane, and the triangles on the positive and the negative side of that.
    let mut faces: Vec<_> = (0..TRIANGLES)
        .filter_map(|i| {
            let [entry, by, exit] = path[i];
            let other = (i + 1..TRIANGLES).find(|&k| middle(k).abs_diff_eq(middle(i), 1e-9))?;
            let cut = entry.cross(exit);
            Some((middle(i), cut * cut.dot(by), [i, other]))
        })
        .collect();
    // Opposite ones together.
    for i in [1, 3, 5] {
        let opposite = (i..faces.len()).find(|&k| faces[k].0.dot(faces[i - 1].0) < -1.0);
        faces.swap(i, opposite.expect("every face has an opposite one"));
    }
    let axes = [0, 2, 4].map(|i| faces[i].0);
    let sort = |portion: usize| {
        let mut found = [const { Vec::new() }; TRIANGLES];
        let mut energy = [0.0; TRIANGLES];
        for cell in portion * PORTION..cells.count().min((portion + 1) * PORTION) {
            let cell = cell as u32;
            let own = cells.energy(cell);
            if own <= 0.0 {
                continue;
            }
            let d = cells.center(cell);
            let [a, b, c] = axes.map(|axis| axis.dot(d));
            let (mut best, mut deepest) = (0, a);
            for (i, depth) in [(2, b), (4, c)] {
                if depth.abs() > deepest.abs() {
                    (best, deepest) = (i, depth);
                }
            }
            let (_, cut, sides) = faces[best + usize::from(deepest < 0.0)];
            let triangle = sides[usize::from(cut.dot(d) < 0.0)];
            found[triangle].push(cell);
            energy[triangle] += own;
        }
        (found, energy)
    };
    let portions: Vec<_> = (0..cells.count().div_ceil(PORTION)).into_par_iter().map(sort).collect();
    let total: f64 = portions.iter().flat_map(|(_, energy)| energy).sum();
    let lit = |&cell: &u32| {
        let share = (cells.energy(cell) / total) as f32;
        Lit { cell, center: cells.center(cell).as_vec3(), share }
    };
    let mut order: Vec<Lit> = bytemuck::zeroed_vec(portions.iter().flat_map(|(found, _)| found).map(Vec::len).sum());
    let (mut rest, mut end) = (&mut order[..], 0);
    let (mut pieces, mut nodes) = (Vec::new(), Vec::new());
    for (i, &corners) in path.iter().enumerate() {
        let begin = end;
        for (found, _) in &portions {
            pieces.push((rest.split_off_mut(..found[i].len()).expect("room for all"), &found[i]));
            end += found[i].len();
        }
        if end > begin {
            let energy = portions.iter().map(|(_, energy)| energy[i]).sum();
            nodes.push(Node { corners, cells: begin..end, energy, square: 0.0, depth: 0, group: nodes.len() });
        }
    }
    pieces.into_par_iter().for_each(|(piece, found)| {
        for (to, cell) in piece.iter_mut().zip(found) {
            *to = lit(cell);
        }
    });
    (Sorted { cells: order, energy: total }, nodes)
}

/// The cube's faces cut along diagonals, each triangle [entry, passed by, exit], such that every one is entered where the
/// one before it was left.
///
/// The diagonals are the edges of a tetrahedron, each walked twice, once for either half of its face: a circuit over all
/// edges of a graph whose corners all have an even number.
fn cube_path() -> Vec<[DVec3; 3]> {
    // Turned out of the axes: floors and walls are everywhere, and no row of triangles should lie along their horizons.
    let turn = DQuat::from_euler(EulerRot::YXZ, 0.4, 0.3, 0.2);
    let corner = |x: i32, y: i32, z: i32| turn * DVec3::new(f64::from(x), f64::from(y), f64::from(z)).normalize();
    let ends = [corner(1, 1, 1), corner(1, -1, -1), corner(-1, 1, -1), corner(-1, -1, 1)];
    // Edges of the tetrahedron in the order of a circuit; the second time round in the same order.
    const CIRCUIT: [(usize, usize); 12] =
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (2, 0), (0, 3), (3, 2), (2, 1), (1, 3), (3, 1), (1, 0)];
    let mut path: Vec<[DVec3; 3]> = Vec::with_capacity(12);
    for (from, to) in CIRCUIT {
        let (entry, exit) = (ends[from], ends[to]);
        // The face's other two corners: one of the antipodes of the remaining ends, each used once.
        let others = (0..4).filter(|&k| k != from && k != to).map(|k| -ends[k]);
        let free = |by: &DVec3| {
            !path.iter().any(|[a, b, c]| b == by && (*a == entry || *c == entry) && (*a == exit || *c == exit))
        };
        let by = others.into_iter().find(free).expect("every diagonal is walked twice");
        path.push([entry, by, exit]);
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    struct Sphere {
        directions: Vec<DVec3>,
        sun: u32,
    }

    impl Cells for Sphere {
        fn count(&self) -> usize {
            self.directions.len()
        }
        fn center(&self, cell: u32) -> DVec3 {
            self.directions[cell as usize]
        }
        fn energy(&self, cell: u32) -> f64 {
            if cell == self.sun {
                1000.0
            } else if cell.is_multiple_of(10) {
                0.0
            } else {
                0.01
            }
        }
        fn solid_angle(&self, _: u32) -> f64 {
            4.0 * PI / self.directions.len() as f64
        }
    }

    fn fibonacci(n: usize) -> Sphere {
        let directions = (0..n)
            .map(|i| {
                let y = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
                let (sin, cos) = (i as f64 * PI * (3.0 - 5f64.sqrt())).sin_cos();
                DVec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin)
            })
            .collect();
        Sphere { directions, sun: 1234 }
    }

    #[test]
    fn the_curve_is_continuous_and_faces_cover_the_sphere() {
        let path = cube_path();
        assert_eq!(path.len(), 12);
        for pair in path.windows(2) {
            assert_eq!(pair[0][2], pair[1][0]);
        }
        let area: f64 = path.iter().map(|&f| spherical_area(f)).sum();
        assert!((area - 4.0 * PI).abs() < 1e-12, "{area}");
    }

    #[test]
    fn leaves_partition_the_lit_cells_and_the_sun_gets_its_own() {
        let cells = fibonacci(20_000);
        let t = Tessellation::new(&cells, 128, 2000);
        let mut seen = vec![0; cells.count()];
        for leaf in &t.leaves {
            for &cell in &t.cells[leaf.clone()] {
                seen[cell as usize] += 1;
            }
        }
        for (cell, &count) in seen.iter().enumerate() {
            assert_eq!(count, i32::from(cells.energy(cell as u32) > 0.0), "cell {cell}");
        }
        assert!(t.groups.len() <= 128 && t.groups.len() > 120, "{}", t.groups.len());
        assert!(t.leaves.len() <= 2000 && t.leaves.len() > 1900, "{}", t.leaves.len());
        assert_eq!(t.groups.iter().map(Range::len).sum::<usize>(), t.leaves.len());
        assert!(t.groups.iter().all(|g| (1..=LEAVES_A_GROUP).contains(&g.len())));
        let sun = t.leaves.iter().find(|leaf| t.cells[(*leaf).clone()].contains(&cells.sun)).unwrap();
        assert_eq!(sun.len(), 1);
    }
}
