//! Memory that the system refuses: an error with a remedy, where Rust would abort. What is known beforehand is refused
//! earlier, part by part (`commands::memory`); this is for limits that the estimate just passes.

#![allow(unsafe_code, reason = "an allocator is unsafe to be one; it hands everything on to the system's")]

use std::alloc::{GlobalAlloc, Layout, System};

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
    if block.is_null() { refused(bytes) } else { block }
}

#[cold]
fn refused(bytes: usize) -> ! {
    say!("domelight: out of memory: {bytes} bytes are refused: give more, or a smaller scene, dome or picture");
    // SAFETY: It ends the process, and runs nothing of it: other threads are still at work.
    unsafe { libc::_exit(2) }
}
