//! Large arrays in large pages: what is read here and there in a hundred megabytes otherwise misses the processor's page
//! table at almost every step. Where the system has none, these are ordinary arrays.

use bytemuck::Pod;
use memmap2::MmapMut;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

/// A large page, bytes. From this size on an array gets pages of its own.
const PAGE: usize = 2 << 20;

/// A fixed number of `T`s, all zero at first.
#[derive(Debug)]
pub(crate) struct Pages<T>(Store<T>);

#[derive(Debug)]
enum Store<T> {
    Small(Vec<T>),
    /// From a byte, where a large page begins, to a byte.
    Large(MmapMut, usize, usize, PhantomData<T>),
}

impl<T: Pod> Pages<T> {
    /// `len` zeroed elements.
    pub(crate) fn zeroed(len: usize) -> Self {
        let bytes = len * size_of::<T>();
        if bytes >= PAGE
            && let Ok(map) = MmapMut::map_anon(bytes + PAGE)
        {
            // Only advice: without it everything is as right, but slower.
            #[cfg(target_os = "linux")]
            let _ = map.advise(memmap2::Advice::HugePage);
            let begin = map.as_ptr().align_offset(PAGE);
            return Self(Store::Large(map, begin, begin + bytes, PhantomData));
        }
        Self(Store::Small(bytemuck::zeroed_vec(len)))
    }
}

/// Whether the system would give this many bytes: under a limit it says so here, where Rust's vectors would end the
/// program.
pub(crate) fn are_free(bytes: usize) -> bool {
    bytes < PAGE || MmapMut::map_anon(bytes).is_ok()
}

impl<T> Default for Pages<T> {
    fn default() -> Self {
        Self(Store::Small(Vec::new()))
    }
}

impl<T: Pod> Deref for Pages<T> {
    type Target = [T];
    #[inline(always)]
    fn deref(&self) -> &[T] {
        match &self.0 {
            Store::Small(elements) => elements,
            Store::Large(map, begin, end, _) => bytemuck::cast_slice(&map[*begin..*end]),
        }
    }
}

impl<T: Pod> DerefMut for Pages<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.0 {
            Store::Small(elements) => elements,
            Store::Large(map, begin, end, _) => bytemuck::cast_slice_mut(&mut map[*begin..*end]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_and_large_arrays_are_zero_and_keep_what_is_written() {
        for len in [0, 1, 1000, PAGE / 4, PAGE / 4 + 12_345] {
            let mut pages = Pages::<u32>::zeroed(len);
            assert!(pages.len() == len && pages.iter().all(|x| *x == 0));
            pages.iter_mut().enumerate().for_each(|(i, x)| *x = i as u32);
            assert!(pages.iter().enumerate().all(|(i, x)| *x == i as u32));
        }
    }
}
