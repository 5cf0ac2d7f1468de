//! Large arrays in huge pages: a ray's way through a tree of some hundred megabytes otherwise misses the processor's
//! page table at almost every node. Where the system has none, these are ordinary arrays.

use bytemuck::Pod;
use memmap2::MmapMut;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

/// From this size on an array gets pages of its own.
const LARGE: usize = 4 << 20;

/// A fixed number of `T`s, all zero at first.
#[derive(Debug)]
pub(super) struct Pages<T>(Store<T>);

#[derive(Debug)]
enum Store<T> {
    Small(Vec<T>),
    Large(MmapMut, PhantomData<T>),
}

impl<T: Pod> Pages<T> {
    /// `len` zeroed elements.
    pub(super) fn zeroed(len: usize) -> Self {
        let bytes = len * size_of::<T>();
        let large = bytes >= LARGE && align_of::<T>() <= 4096;
        if let Some(Ok(map)) = large.then(|| MmapMut::map_anon(bytes)) {
            // Only advice: without it everything is as right, but slower.
            #[cfg(target_os = "linux")]
            let _ = map.advise(memmap2::Advice::HugePage);
            return Self(Store::Large(map, PhantomData));
        }
        Self(Store::Small(bytemuck::zeroed_vec(len)))
    }
}

/// Whether the system would give this many bytes: under a limit it says so here, where Rust's vectors would abort.
pub(super) fn are_free(bytes: usize) -> bool {
    bytes < LARGE || MmapMut::map_anon(bytes).is_ok()
}

impl<T> Default for Pages<T> {
    fn default() -> Self {
        Self(Store::Small(Vec::new()))
    }
}

impl<T: Pod> Deref for Pages<T> {
    type Target = [T];
    #[inline]
    fn deref(&self) -> &[T] {
        match &self.0 {
            Store::Small(elements) => elements,
            Store::Large(map, _) => bytemuck::cast_slice(map),
        }
    }
}

impl<T: Pod> DerefMut for Pages<T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.0 {
            Store::Small(elements) => elements,
            Store::Large(map, _) => bytemuck::cast_slice_mut(map),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_and_large_arrays_are_zero_and_keep_what_is_written() {
        for len in [0, 1, 1000, LARGE / 4, LARGE / 4 + 12_345] {
            let mut pages = Pages::<u32>::zeroed(len);
            assert!(pages.len() == len && pages.iter().all(|x| *x == 0));
            pages.iter_mut().enumerate().for_each(|(i, x)| *x = i as u32);
            assert!(pages.iter().enumerate().all(|(i, x)| *x == i as u32));
        }
    }
}
