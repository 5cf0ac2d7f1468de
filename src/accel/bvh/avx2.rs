//! The kernel for AVX2 and FMA: eight boxes or eight triangles in a register.

#![allow(unsafe_code, reason = "a SIMD kernel; `portable` is its twin")]

use super::node::{Block, Node, WIDTH};
use super::packet::{PACKET, Packet};
use super::portable::{CLOSE, ahead};
use super::traverse::{Kernel, LATER, Met, Prepared};
use super::{Questions, World};
use crate::accel::{Coherence, Hit, Mask, Ray};
use std::arch::x86_64::*;

/// The kernel for AVX2 and FMA.
pub(super) struct Avx2;

/// The batches with this kernel, if the processor has what it takes.
pub(super) fn questions() -> Option<Questions> {
    (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Questions {
        // SAFETY: The processor has been asked.
        closest: |world, rays, mask, coherence, hits| unsafe { closest(world, rays, mask, coherence, hits) },
        // SAFETY: As above.
        any: |world, rays, mask, occluded| unsafe { any(world, rays, mask, occluded) },
    })
}

/// # Safety
/// The processor has AVX2 and FMA.
#[target_feature(enable = "avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn closest(world: &World, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
    World::closest::<Avx2>(world, rays, mask, coherence, hits);
}

/// # Safety
/// The processor has AVX2 and FMA.
#[target_feature(enable = "avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn any(world: &World, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
    World::any::<Avx2>(world, rays, mask, occluded);
}

// No closures below: unlike these functions they are not always inlined, and outside of a function with the target
// features an intrinsic is a call.

/// The same number in every lane.
#[inline(always)]
fn all(x: f32) -> __m256 {
    // SAFETY: Inlined only where AVX is enabled.
    unsafe { _mm256_set1_ps(x) }
}

/// (plane − origin) / direction for a row of planes.
#[inline(always)]
fn slab(node: &Node, row: usize, inverse: f32, shift: f32) -> __m256 {
    // SAFETY: Inlined only where AVX2 and FMA are enabled; a row is eight floats, aligned to 32 bytes as `Node` is to 64.
    unsafe { _mm256_fmsub_ps(_mm256_load_ps(node.planes[row].as_ptr()), all(inverse), all(shift)) }
}

/// Where the boxes are entered and left.
#[inline(always)]
pub(super) fn slabs(ray: &Prepared, node: &Node) -> (__m256, __m256) {
    let ([x, y, z], [inverse_x, inverse_y, inverse_z]) = (ray.near, ray.inverse);
    let enter_x = slab(node, x, inverse_x, ray.enter[0]);
    let enter_y = slab(node, y, inverse_y, ray.enter[1]);
    let enter_z = slab(node, z, inverse_z, ray.enter[2]);
    let leave_x = slab(node, 3 - x, inverse_x, ray.leave[0]);
    let leave_y = slab(node, 5 - y, inverse_y, ray.leave[1]);
    let leave_z = slab(node, 7 - z, inverse_z, ray.leave[2]);
    // SAFETY: Inlined only where AVX is enabled.
    unsafe {
        let enter = _mm256_max_ps(_mm256_max_ps(enter_x, enter_y), _mm256_max_ps(enter_z, all(ray.tnear)));
        let leave = _mm256_min_ps(_mm256_min_ps(leave_x, leave_y), _mm256_min_ps(leave_z, all(ray.tfar)));
        (enter, _mm256_mul_ps(leave, all(LATER)))
    }
}

/// Eight numbers of a packet's row.
#[inline(always)]
fn eight(row: &[f32; PACKET], from: usize) -> __m256 {
    let part: &[f32; 8] =
        if from == 0 { row[..8].first_chunk().unwrap_or(&[0.0; 8]) } else { row.last_chunk().unwrap_or(&[0.0; 8]) };
    // SAFETY: Inlined only where AVX is enabled; eight floats.
    unsafe { _mm256_loadu_ps(part.as_ptr()) }
}

/// Which of eight rays of a packet meet the box of a child.
#[inline(always)]
fn rays(packet: &Packet, node: &Node, child: usize, from: usize) -> u32 {
    let (mut enter, mut leave) = (eight(&packet.tnear, from), eight(&packet.tfar, from));
    for axis in 0..3 {
        let near = node.planes[packet.near[axis]][child];
        let far = node.planes[2 * axis + 3 - packet.near[axis]][child];
        let inverse = eight(&packet.inverse[axis], from);
        // SAFETY: Inlined only where AVX2 and FMA are enabled.
        unsafe {
            enter = _mm256_max_ps(enter, _mm256_fmsub_ps(all(near), inverse, eight(&packet.enter[axis], from)));
            leave = _mm256_min_ps(leave, _mm256_fmsub_ps(all(far), inverse, eight(&packet.leave[axis], from)));
        }
    }
    // SAFETY: As above.
    unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, _mm256_mul_ps(leave, all(LATER)))) as u32 }
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
    fn rays(packet: &Packet, node: &Node, child: usize) -> u32 {
        rays(packet, node, child, 0) | rays(packet, node, child, 8) << 8
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
        let (mut ts, mut us, mut vs) = ([0.0; 8], [0.0; 8], [0.0; 8]);
        // SAFETY: Stores of eight floats into arrays of eight.
        unsafe {
            _mm256_storeu_ps(ts.as_mut_ptr(), t);
            _mm256_storeu_ps(us.as_mut_ptr(), u);
            _mm256_storeu_ps(vs.as_mut_ptr(), v);
        }
        let mut lane = mask.trailing_zeros() as usize & 7;
        let mut rest = mask & (mask - 1);
        while rest != 0 {
            let other = rest.trailing_zeros() as usize & 7;
            if ts[other] < ts[lane] {
                lane = other;
            }
            rest &= rest - 1;
        }
        Some(Met { lane, t: ts[lane], u: us[lane], v: vs[lane] })
    }
}

/// Which of eight triangles are met, where, and with which weights.
struct Edges {
    mask: u32,
    t: __m256,
    u: __m256,
    v: __m256,
}

/// A corner of each triangle, sheared.
#[inline(always)]
fn corner(ray: &Prepared, block: &Block, vertex: usize) -> [__m256; 3] {
    let ([kx, ky, kz], rows) = (ray.axes, &block.corners[vertex]);
    // SAFETY: Inlined only where AVX2 and FMA are enabled; a row is eight floats, aligned to 32 bytes as `Block` is.
    unsafe {
        let x = _mm256_sub_ps(_mm256_load_ps(rows[kx].as_ptr()), all(ray.origin[0]));
        let y = _mm256_sub_ps(_mm256_load_ps(rows[ky].as_ptr()), all(ray.origin[1]));
        let z = _mm256_sub_ps(_mm256_load_ps(rows[kz].as_ptr()), all(ray.origin[2]));
        [_mm256_fnmadd_ps(all(ray.shear[0]), z, x), _mm256_fnmadd_ps(all(ray.shear[1]), z, y), z]
    }
}

/// As `portable::meets`, eight at once.
#[inline(always)]
fn edges(ray: &Prepared, block: &Block) -> Edges {
    // SAFETY: Inlined only where AVX2 and FMA are enabled.
    unsafe {
        let [a, b, c] = [corner(ray, block, 0), corner(ray, block, 1), corner(ray, block, 2)];
        // Not fused: the two triangles at an edge must get the same number.
        let u = _mm256_sub_ps(_mm256_mul_ps(c[0], b[1]), _mm256_mul_ps(c[1], b[0]));
        let v = _mm256_sub_ps(_mm256_mul_ps(a[0], c[1]), _mm256_mul_ps(a[1], c[0]));
        let w = _mm256_sub_ps(_mm256_mul_ps(b[0], a[1]), _mm256_mul_ps(b[1], a[0]));
        let det = _mm256_add_ps(_mm256_add_ps(u, v), w);
        let zero = _mm256_setzero_ps();
        let least = _mm256_min_ps(_mm256_min_ps(u, v), w);
        let most = _mm256_max_ps(_mm256_max_ps(u, v), w);
        let inside = _mm256_or_ps(_mm256_cmp_ps::<_CMP_GE_OQ>(least, zero), _mm256_cmp_ps::<_CMP_LE_OQ>(most, zero));
        let inside = _mm256_and_ps(inside, _mm256_cmp_ps::<_CMP_NEQ_OQ>(det, zero));
        if _mm256_movemask_ps(inside) == 0 {
            return Edges { mask: 0, t: zero, u: zero, v: zero };
        }
        let scale = _mm256_div_ps(all(1.0), det);
        let (u, v, w) = (_mm256_mul_ps(u, scale), _mm256_mul_ps(v, scale), _mm256_mul_ps(w, scale));
        let t = _mm256_fmadd_ps(u, a[2], _mm256_fmadd_ps(v, b[2], _mm256_mul_ps(w, c[2])));
        let t = _mm256_mul_ps(t, all(ray.shear[2]));
        let beyond = _mm256_cmp_ps::<_CMP_GT_OQ>(t, all(ray.tnear));
        let within = _mm256_and_ps(beyond, _mm256_cmp_ps::<_CMP_LT_OQ>(t, all(ray.tfar)));
        let met = _mm256_and_ps(inside, within);
        let mut mask = _mm256_movemask_ps(met) as u32;
        if mask != 0 {
            let sign = all(-0.0);
            let reach = _mm256_max_ps(_mm256_andnot_ps(sign, a[2]), _mm256_andnot_ps(sign, b[2]));
            let reach = _mm256_max_ps(reach, _mm256_andnot_ps(sign, c[2]));
            let reach = _mm256_mul_ps(reach, all(CLOSE * ray.shear[2].abs()));
            let mut close = _mm256_movemask_ps(_mm256_and_ps(met, _mm256_cmp_ps::<_CMP_LE_OQ>(t, reach))) as u32;
            while close != 0 {
                let lane = close.trailing_zeros();
                if !ahead(ray, block, lane as usize & 7) {
                    mask &= !(1 << lane);
                }
                close &= close - 1;
            }
        }
        Edges { mask, t, u: v, v: w }
    }
}
