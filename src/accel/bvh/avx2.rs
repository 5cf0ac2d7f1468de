//! The kernel for AVX2 and FMA: eight boxes in a register, four triangles in half of one.

#![allow(unsafe_code, reason = "a SIMD kernel; `portable` is its twin")]

use super::node::{Block, Node, WIDTH};
use super::traverse::{Kernel, LATER, Met, Prepared};
use super::{Questions, World};
use crate::accel::{Hit, Mask, Ray};
use std::arch::x86_64::*;

/// The kernel for AVX2 and FMA.
pub(super) struct Avx2;

/// The batches with this kernel, if the processor has what it takes.
pub(super) fn questions() -> Option<Questions> {
    (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Questions {
        // SAFETY: The processor has been asked.
        closest: |world, rays, mask, hits| unsafe { closest(world, rays, mask, hits) },
        // SAFETY: As above.
        any: |world, rays, mask, occluded| unsafe { any(world, rays, mask, occluded) },
    })
}

/// # Safety
/// The processor has AVX2 and FMA.
#[target_feature(enable = "avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn closest(world: &World, rays: &[Ray], mask: Mask, hits: &mut [Hit]) {
    World::closest::<Avx2>(world, rays, mask, hits);
}

/// # Safety
/// The processor has AVX2 and FMA.
#[target_feature(enable = "avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn any(world: &World, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
    World::any::<Avx2>(world, rays, mask, occluded);
}

/// Where the boxes are entered and left.
#[inline(always)]
pub(super) fn slabs(ray: &Prepared, node: &Node) -> (__m256, __m256) {
    // SAFETY: Inlined only where AVX2 and FMA are enabled; the loads are of whole rows of eight floats, each row
    // aligned to 32 bytes as `Node` is to 64.
    unsafe {
        let near = |axis: usize| _mm256_load_ps(node.planes[ray.near[axis]].as_ptr());
        let far = |axis: usize| _mm256_load_ps(node.planes[2 * axis + 3 - ray.near[axis]].as_ptr());
        let all = |x: f32| _mm256_set1_ps(x);
        let enter = |axis| _mm256_fmsub_ps(near(axis), all(ray.inverse[axis]), all(ray.enter[axis]));
        let leave = |axis| _mm256_fmsub_ps(far(axis), all(ray.inverse[axis]), all(ray.leave[axis]));
        let enter = _mm256_max_ps(_mm256_max_ps(enter(0), enter(1)), _mm256_max_ps(enter(2), all(ray.tnear)));
        let leave = _mm256_min_ps(_mm256_min_ps(leave(0), leave(1)), _mm256_min_ps(leave(2), all(ray.tfar)));
        (enter, _mm256_mul_ps(leave, all(LATER)))
    }
}

/// Asks for every cache line of `what`.
#[inline(always)]
pub(super) fn prefetch<T>(what: &T) {
    let start = std::ptr::from_ref(what).cast::<i8>();
    for line in 0..size_of::<T>().div_ceil(64) {
        // SAFETY: Within `what`; a prefetch reads nothing.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(start.add(64 * line)) };
    }
}

/// For each mask of eight bits: the places of the ones, lowest first, a byte each.
const PLACES: [u64; 256] = {
    let mut table = [0; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            if mask >> bit & 1 == 1 {
                table[mask] |= (bit as u64) << (8 * count);
                count += 1;
            }
            bit += 1;
        }
        mask += 1;
    }
    table
};

impl Kernel for Avx2 {
    #[inline(always)]
    fn boxes(ray: &Prepared, node: &Node, children: &mut [u32; WIDTH], at: &mut [f32; WIDTH]) -> usize {
        let (enter, leave) = slabs(ray, node);
        // SAFETY: Inlined only where AVX2 is enabled; loads and stores are of whole rows of eight.
        unsafe {
            let order = _mm256_load_si256(node.order.as_ptr().cast());
            let order = _mm256_srl_epi32(order, _mm_cvtsi32_si128(ray.shift as i32));
            // Permutations read the lowest three bits.
            let enter = _mm256_permutevar8x32_ps(enter, order);
            let leave = _mm256_permutevar8x32_ps(leave, order);
            let mask = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as usize;
            let references = _mm256_load_si256(node.children.as_ptr().cast());
            let references = _mm256_permutevar8x32_epi32(references, order);
            let places = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(PLACES[mask & 255] as i64));
            let references = _mm256_permutevar8x32_epi32(references, places);
            _mm256_storeu_si256(children.as_mut_ptr().cast(), references);
            _mm256_storeu_ps(at.as_mut_ptr(), _mm256_permutevar8x32_ps(enter, places));
            mask.count_ones() as usize
        }
    }

    #[inline(always)]
    fn prefetch<T>(what: &T) {
        prefetch(what);
    }

    #[inline(always)]
    fn any(ray: &Prepared, block: &Block) -> bool {
        edges(ray, block).mask != 0
    }

    #[inline(always)]
    fn closest(ray: &Prepared, block: &Block) -> Option<Met> {
        let Edges { mask, t, u, v } = edges(ray, block);
        if mask == 0 {
            return None;
        }
        let (mut ts, mut us, mut vs) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        // SAFETY: Stores of four floats into arrays of four.
        unsafe {
            _mm_storeu_ps(ts.as_mut_ptr(), t);
            _mm_storeu_ps(us.as_mut_ptr(), u);
            _mm_storeu_ps(vs.as_mut_ptr(), v);
        }
        let mut lane = mask.trailing_zeros() as usize & 3;
        let mut rest = mask & (mask - 1);
        while rest != 0 {
            let other = rest.trailing_zeros() as usize & 3;
            if ts[other] < ts[lane] {
                lane = other;
            }
            rest &= rest - 1;
        }
        Some(Met { lane, t: ts[lane], u: us[lane], v: vs[lane] })
    }
}

/// Which of four triangles are met, where, and with which weights.
struct Edges {
    mask: u32,
    t: __m128,
    u: __m128,
    v: __m128,
}

/// As `portable::meets`, four at once.
#[inline(always)]
fn edges(ray: &Prepared, block: &Block) -> Edges {
    // SAFETY: Inlined only where AVX2 and FMA are enabled; the loads are of whole rows of four floats, each row aligned
    // to 16 bytes as `Block` is.
    unsafe {
        let [kx, ky, kz] = ray.axes;
        let [ox, oy, oz] = ray.origin.map(|x| _mm_set1_ps(x));
        let [sx, sy, sz] = ray.shear.map(|x| _mm_set1_ps(x));
        let corner = |vertex: usize| {
            let axes = &block.corners[vertex];
            let z = _mm_sub_ps(_mm_load_ps(axes[kz].as_ptr()), oz);
            let x = _mm_fnmadd_ps(sx, z, _mm_sub_ps(_mm_load_ps(axes[kx].as_ptr()), ox));
            let y = _mm_fnmadd_ps(sy, z, _mm_sub_ps(_mm_load_ps(axes[ky].as_ptr()), oy));
            [x, y, z]
        };
        let (a, b, c) = (corner(0), corner(1), corner(2));
        // Not fused: the two triangles at an edge must get the same number.
        let u = _mm_sub_ps(_mm_mul_ps(c[0], b[1]), _mm_mul_ps(c[1], b[0]));
        let v = _mm_sub_ps(_mm_mul_ps(a[0], c[1]), _mm_mul_ps(a[1], c[0]));
        let w = _mm_sub_ps(_mm_mul_ps(b[0], a[1]), _mm_mul_ps(b[1], a[0]));
        let det = _mm_add_ps(_mm_add_ps(u, v), w);
        let zero = _mm_setzero_ps();
        let least = _mm_min_ps(_mm_min_ps(u, v), w);
        let most = _mm_max_ps(_mm_max_ps(u, v), w);
        let inside = _mm_or_ps(_mm_cmpge_ps(least, zero), _mm_cmple_ps(most, zero));
        let inside = _mm_and_ps(inside, _mm_cmpneq_ps(det, zero));
        if _mm_movemask_ps(inside) == 0 {
            return Edges { mask: 0, t: zero, u: zero, v: zero };
        }
        let scale = _mm_div_ps(_mm_set1_ps(1.0), det);
        let (u, v, w) = (_mm_mul_ps(u, scale), _mm_mul_ps(v, scale), _mm_mul_ps(w, scale));
        let t = _mm_fmadd_ps(u, a[2], _mm_fmadd_ps(v, b[2], _mm_mul_ps(w, c[2])));
        let t = _mm_mul_ps(t, sz);
        let beyond = _mm_cmpgt_ps(t, _mm_set1_ps(ray.tnear));
        let within = _mm_and_ps(beyond, _mm_cmplt_ps(t, _mm_set1_ps(ray.tfar)));
        Edges { mask: _mm_movemask_ps(_mm_and_ps(inside, within)) as u32, t, u: v, v: w }
    }
}
