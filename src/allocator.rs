//! Memory that the system refuses: an error with a remedy, where Rust would abort. What is known beforehand is refused
//! earlier, part by part (`commands::memory`); this is for limits that the estimate just passes. And large pages for large
//! blocks.

#![allow(unsafe_code, reason = "an allocator is unsafe to be one; it hands everything on to the system's")]

use std::alloc::{GlobalAlloc, Layout, System};

/// A large page, bytes: blocks from this size on ask for them.
#[cfg(target_os = "linux")]
const LARGE: usize = 2 << 20;

#[global_allocator]
static ALLOCATOR: OrExit = OrExit;

/// The system's allocator, or the end of the program.
struct OrExit;

// SAFETY: Every call goes to the system's allocator, which keeps the contract, with the arguments it came with.
unsafe impl GlobalAlloc for OrExit {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: The caller's word is handed on.
        given(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: As above.
        given(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: As above.
        given(unsafe { System.realloc(block, layout, size) }, size)
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: As above.
        unsafe { System.dealloc(block, layout) }
    }
}

/// The block of so many bytes, if it is one.
#[inline(always)]
fn given(block: *mut u8, bytes: usize) -> *mut u8 {
    if block.is_null() {
        refused(bytes)
    }
    #[cfg(target_os = "linux")]
    if bytes >= LARGE {
        in_large_pages(block, bytes);
    }
    block
}

/// Asks for large pages where they fit in: what is touched first costs a hundredth of the faults, and what is read here
/// and there misses the processor's page table less. Only advice: without it everything is as right, but slower.
#[cfg(target_os = "linux")]
#[cold]
fn in_large_pages(block: *mut u8, bytes: usize) {
    // SAFETY: The pages hold parts of a block just handed out, and what is asked for changes nothing of what they hold.
    unsafe {
        // From the page that the block begins in: beside it lies its header alone, which the first large page takes in.
        let beside = block as usize % libc::sysconf(libc::_SC_PAGESIZE).max(1) as usize;
        libc::madvise(block.wrapping_sub(beside).cast(), bytes + beside, libc::MADV_HUGEPAGE);
    }
}

#[cold]
fn refused(bytes: usize) -> ! {
    say!("domelight: out of memory: {bytes} bytes are refused: give more, or a smaller scene, dome or picture");
    // SAFETY: It ends the process, and runs nothing of it: other threads are still at work.
    unsafe { libc::_exit(2) }
}
