//! The kernel for AVX-512 on 256-bit registers: as `avx2`, with a compression in place of a table, and registers enough
//! for the whole ray.

#![allow(unsafe_code, reason = "a SIMD kernel; `portable` is its twin")]

use super::avx2::{Avx2, slabs};
use super::node::{Block, Node, WIDTH};
use super::packet::Packet;
use super::traverse::{Kernel, Met, Prepared};
use super::{Questions, World};
use crate::accel::{Coherence, Hit, Mask, Ray};
use std::arch::x86_64::*;

/// The kernel for AVX-512 F and VL.
pub(super) struct Avx512;

/// The batches with this kernel, if the processor has what it takes.
pub(super) fn questions() -> Option<Questions> {
    (is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("fma"))
    .then_some(Questions {
        // SAFETY: The processor has been asked.
        closest: |world, rays, mask, coherence, hits| unsafe { closest(world, rays, mask, coherence, hits) },
        // SAFETY: As above.
        any: |world, rays, mask, occluded| unsafe { any(world, rays, mask, occluded) },
    })
}

/// # Safety
/// The processor has AVX-512 F and VL, AVX2 and FMA.
#[target_feature(enable = "avx512f,avx512vl,avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn closest(world: &World, rays: &[Ray], mask: Mask, coherence: Coherence, hits: &mut [Hit]) {
    World::closest::<Avx512>(world, rays, mask, coherence, hits);
}

/// # Safety
/// The processor has AVX-512 F and VL, AVX2 and FMA.
#[target_feature(enable = "avx512f,avx512vl,avx2,fma,bmi1,lzcnt,popcnt")]
unsafe fn any(world: &World, rays: &[Ray], mask: Mask, occluded: &mut [u8]) {
    World::any::<Avx512>(world, rays, mask, occluded);
}

impl Kernel for Avx512 {
    #[inline(always)]
    fn boxes(ray: &Prepared, node: &Node, children: &mut [u32; WIDTH], at: &mut [f32; WIDTH]) -> usize {
        let (enter, leave) = slabs(ray, node);
        // SAFETY: Inlined only where AVX-512 is enabled; loads and stores are of whole rows of eight.
        unsafe {
            let order = _mm256_load_si256(node.order.as_ptr().cast());
            let order = _mm256_srl_epi32(order, _mm_cvtsi32_si128(ray.shift as i32));
            let enter = _mm256_permutexvar_ps(order, enter);
            let leave = _mm256_permutexvar_ps(order, leave);
            let mask = _mm256_cmp_ps_mask::<_CMP_LE_OQ>(enter, leave);
            let references = _mm256_permutexvar_epi32(order, _mm256_load_si256(node.children.as_ptr().cast()));
            // Compressed in registers: compressing stores are microcode on Zen 4.
            let references = _mm256_maskz_compress_epi32(mask, references);
            _mm256_storeu_si256(children.as_mut_ptr().cast(), references);
            _mm256_storeu_ps(at.as_mut_ptr(), _mm256_maskz_compress_ps(mask, enter));
            mask.count_ones() as usize
        }
    }

    #[inline(always)]
    fn rays(packet: &Packet, node: &Node, child: usize) -> u32 {
        Avx2::rays(packet, node, child)
    }

    #[inline(always)]
    fn prefetch<T>(what: &T) {
        Avx2::prefetch(what);
    }

    #[inline(always)]
    fn any(ray: &Prepared, block: &Block) -> bool {
        Avx2::any(ray, block)
    }

    #[inline(always)]
    fn closest(ray: &Prepared, block: &Block) -> Option<Met> {
        Avx2::closest(ray, block)
    }
}
