//! The builder: top-down, surface area heuristic over 16 bins an axis, eight children at once.
//!
//! A node begins as one range of primitives; the child of the largest surface is split until there are eight (Wald,
//! Benthin & Boulos 2008). Ranges below [`GRAIN`] are one task that fills an arena of its own; the arenas are copied
//! together at the end, in parallel, all trees of a scene into one [`Forest`].

use super::node::{Aabb, BLOCK, Block, Forest, INSTANCE, Ids, LEAF, Node, Root, WIDTH};
use super::split::{Info, split};
use crate::pages::Pages;
use glam::Vec3;
use rayon::prelude::*;

/// Primitives that one task builds.
const GRAIN: usize = 16_384;
/// From this depth on ranges are halved, which bounds the stack of a traversal.
const DEEP: usize = 32;
/// The deepest a tree can be: halving 2³¹ primitives into eighths takes another 11 levels.
pub(super) const MAX_DEPTH: usize = DEEP + 11;

/// A primitive: its box and what it is.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Primitive {
    pub(super) low: Vec3,
    /// Index of what it belongs to: for the caller's use, or of the instance it is.
    pub(super) item: u32,
    pub(super) high: Vec3,
    /// Index of the triangle; [`Primitive::IS_INSTANCE`] for an instance.
    pub(super) triangle: u32,
}

impl Primitive {
    /// Says that the primitive is an instance.
    pub(super) const IS_INSTANCE: u32 = u32::MAX;
    /// A primitive that is to be left out has this as its lower x.
    pub(super) const ABSENT: f32 = f32::INFINITY;
}

/// Where the corners and the instance of a primitive are found.
pub(super) trait Source: Sync {
    /// The corners of a triangle and its instance.
    fn triangle(&self, primitive: &Primitive) -> ([Vec3; 3], u32);
}

/// A tree that has not found its place in the forest yet.
pub(super) struct Tree {
    built: Built,
    /// The box of everything in it.
    pub(super) bounds: Aabb,
}

/// Builds on the current rayon pool; nothing for no primitives.
pub(super) fn build(source: &impl Source, primitives: &mut [Primitive]) -> Option<Tree> {
    if primitives.is_empty() {
        return None;
    }
    let info = Info::of(primitives);
    Some(Tree { built: node(source, primitives, info, 0), bounds: info.bounds })
}

impl Tree {
    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        self.built.bytes()
    }
}

/// A subtree: one arena, or a node over subtrees.
enum Built {
    Small(Arena),
    Large { node: Box<Node>, children: Vec<Built> },
}

impl Built {
    fn bytes(&self) -> u64 {
        match self {
            Self::Small(arena) => arena.bytes(),
            Self::Large { children, .. } => children.iter().map(Self::bytes).sum(),
        }
    }
}

/// A subtree with references of its own; the root is the reference that leads into it.
#[derive(Default)]
struct Arena {
    nodes: Vec<Node>,
    blocks: Vec<Block>,
    ids: Vec<Ids>,
    root: u32,
}

impl Arena {
    fn bytes(&self) -> u64 {
        (size_of_val(&*self.nodes) + size_of_val(&*self.blocks) + size_of_val(&*self.ids)) as u64
    }
}

fn is_leaf(primitives: &[Primitive]) -> bool {
    let all_triangles = || primitives.iter().all(|p| p.triangle != Primitive::IS_INSTANCE);
    primitives.len() == 1 || primitives.len() <= BLOCK && all_triangles()
}

/// Splits a range into up to eight.
fn children(primitives: &mut [Primitive], info: Info, depth: usize) -> Vec<(&mut [Primitive], Info)> {
    let mut children = Vec::with_capacity(WIDTH);
    children.push((primitives, info));
    while children.len() < WIDTH {
        let mut largest = None;
        for (i, (range, info)) in children.iter().enumerate() {
            let area = info.bounds.half_area();
            if !is_leaf(range) && largest.is_none_or(|(_, a)| area > a) {
                largest = Some((i, area));
            }
        }
        let Some((i, _)) = largest else { break };
        let (range, info) = children.swap_remove(i);
        let (middle, left, right) = split(range, &info, depth >= DEEP);
        let (low, high) = range.split_at_mut(middle);
        children.push((low, left));
        children.push((high, right));
    }
    children
}

fn node(source: &impl Source, primitives: &mut [Primitive], info: Info, depth: usize) -> Built {
    if primitives.len() <= GRAIN {
        let mut arena = Arena::default();
        arena.nodes.reserve(primitives.len() / 12 + 1);
        arena.blocks.reserve(primitives.len() / 3 + 1);
        arena.ids.reserve(primitives.len() / 3 + 1);
        arena.root = if depth > 0 && is_leaf(primitives) {
            leaf(source, primitives, &mut arena)
        } else {
            small_node(source, primitives, info, depth, &mut arena)
        };
        return Built::Small(arena);
    }
    let children = children(primitives, info, depth);
    let boxes: Vec<Aabb> = children.iter().map(|(_, info)| info.bounds).collect();
    let children = children.into_par_iter().map(|(range, info)| self::node(source, range, info, depth + 1)).collect();
    Built::Large { node: Box::new(Node::new(&boxes)), children }
}

fn small_node(source: &impl Source, primitives: &mut [Primitive], info: Info, depth: usize, arena: &mut Arena) -> u32 {
    let children = children(primitives, info, depth);
    let mut boxes = [Aabb::EMPTY; WIDTH];
    for (aabb, (_, info)) in boxes.iter_mut().zip(&children) {
        *aabb = info.bounds;
    }
    let index = arena.nodes.len();
    arena.nodes.push(Node::new(&boxes[..children.len()]));
    for (lane, (range, info)) in children.into_iter().enumerate() {
        let reference =
            if is_leaf(range) { leaf(source, range, arena) } else { small_node(source, range, info, depth + 1, arena) };
        arena.nodes[index].children[lane] = reference;
    }
    index as u32
}

fn leaf(source: &impl Source, primitives: &[Primitive], arena: &mut Arena) -> u32 {
    if primitives[0].triangle == Primitive::IS_INSTANCE {
        return LEAF | INSTANCE | primitives[0].item;
    }
    let mut block = Block { corners: [[[0.0; BLOCK]; 3]; 3] };
    let mut ids = Ids { instance: [0; BLOCK], triangle: [0; BLOCK] };
    for lane in 0..BLOCK {
        let filled = lane < primitives.len();
        let primitive = &primitives[if filled { lane } else { 0 }];
        let (corners, instance) = source.triangle(primitive);
        for (vertex, corner) in corners.iter().enumerate() {
            let corner = if filled { corner } else { &corners[0] };
            for axis in 0..3 {
                block.corners[vertex][axis][lane] = corner[axis];
            }
        }
        (ids.instance[lane], ids.triangle[lane]) = (instance, primitive.triangle);
    }
    arena.blocks.push(block);
    arena.ids.push(ids);
    LEAF | (arena.blocks.len() - 1) as u32
}

/// Copies trees into one forest, the nodes above the arenas first, and tells where each tree begins.
pub(super) fn join(trees: Vec<Tree>) -> (Forest, Vec<Root>) {
    let (mut top, mut arenas) = (Vec::new(), Vec::new());
    let mut roots = Vec::with_capacity(trees.len());
    for Tree { built, bounds } in trees {
        let extent = bounds.low.abs().max(bounds.high.abs()).max_element();
        roots.push(Root { reference: flatten(built, &mut top, &mut arenas), extent });
    }
    let count = |of: fn(&Arena) -> usize| arenas.iter().map(of).sum::<usize>();
    let mut forest = Forest {
        nodes: Pages::zeroed(top.len() + count(|a| a.nodes.len())),
        blocks: Pages::zeroed(count(|a| a.blocks.len())),
        ids: Pages::zeroed(count(|a| a.ids.len())),
    };
    let (top_nodes, mut nodes) = forest.nodes.split_at_mut(top.len());
    let (mut blocks, mut ids) = (&mut *forest.blocks, &mut *forest.ids);
    let (mut first_node, mut first_block) = (top.len() as u32, 0u32);
    let mut arena_roots = Vec::with_capacity(arenas.len());
    let mut copies = Vec::with_capacity(arenas.len());
    for arena in arenas {
        let (n, b) = (arena.nodes.len(), arena.blocks.len());
        arena_roots.push(moved(arena.root, first_node, first_block));
        let (to_nodes, to_blocks, to_ids);
        (to_nodes, nodes) = nodes.split_at_mut(n);
        (to_blocks, blocks) = blocks.split_at_mut(b);
        (to_ids, ids) = ids.split_at_mut(b);
        copies.push((arena, first_node, first_block, to_nodes, to_blocks, to_ids));
        (first_node, first_block) = (first_node + n as u32, first_block + b as u32);
    }
    copies.into_par_iter().for_each(|(from, first_node, first_block, nodes, blocks, ids)| {
        for (to, node) in nodes.iter_mut().zip(&from.nodes) {
            *to = *node;
            to.children = node.children.map(|c| moved(c, first_node, first_block));
        }
        blocks.copy_from_slice(&from.blocks);
        ids.copy_from_slice(&from.ids);
    });
    // Up to here a leaf was an arena, anything else another node of the top.
    let found = |reference: u32| match reference & LEAF {
        0 => reference,
        _ => arena_roots[(reference & !LEAF) as usize],
    };
    for (to, node) in top_nodes.iter_mut().zip(&top) {
        *to = Node { children: node.children.map(found), ..*node };
    }
    roots.iter_mut().for_each(|root| root.reference = found(root.reference));
    (forest, roots)
}

fn moved(reference: u32, first_node: u32, first_block: u32) -> u32 {
    match reference & (LEAF | INSTANCE) {
        LEAF => reference + first_block,
        0 => reference + first_node,
        _ => reference,
    }
}

/// Numbers the nodes above the arenas and the arenas; returns the reference.
fn flatten(built: Built, top: &mut Vec<Node>, arenas: &mut Vec<Arena>) -> u32 {
    match built {
        Built::Small(arena) => {
            arenas.push(arena);
            LEAF | (arenas.len() - 1) as u32
        }
        Built::Large { node, children } => {
            let index = top.len();
            top.push(*node);
            for (lane, child) in children.into_iter().enumerate() {
                let reference = flatten(child, top, arenas);
                top[index].children[lane] = reference;
            }
            index as u32
        }
    }
}
