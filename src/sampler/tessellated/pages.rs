//! Rows that are read here and there: kept in large pages, where the system has them, so that a look-up does not wait for
//! the page's address first.

use bytemuck::Pod;
use memmap2::MmapMut;
use std::marker::PhantomData;

/// A large page, bytes.
const PAGE: usize = 2 << 20;

/// A row in memory of its own.
#[derive(Debug)]
pub(super) struct Row<T> {
    map: MmapMut,
    /// Bytes.
    begin: usize,
    end: usize,
    kind: PhantomData<T>,
}

impl<T: Pod> Row<T> {
    /// `len` zeros.
    pub(super) fn new(len: usize) -> Self {
        let bytes = len * size_of::<T>();
        // Room to begin where a large page does, if the row can fill one.
        let room = if bytes < PAGE { 1 } else { PAGE };
        let map = MmapMut::map_anon(bytes + room).expect("anonymous memory is refused when there is none left");
        let begin = if bytes < PAGE { 0 } else { map.as_ptr().align_offset(PAGE) };
        // Only advice: a system without large pages has small ones.
        #[cfg(target_os = "linux")]
        let _ = map.advise(memmap2::Advice::HugePage);
        Self { map, begin, end: begin + bytes, kind: PhantomData }
    }

    #[inline(always)]
    pub(super) fn get(&self) -> &[T] {
        bytemuck::cast_slice(&self.map[self.begin..self.end])
    }

    pub(super) fn get_mut(&mut self) -> &mut [T] {
        bytemuck::cast_slice_mut(&mut self.map[self.begin..self.end])
    }
}
