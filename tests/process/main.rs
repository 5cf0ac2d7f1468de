//! The program as a process: what it does when it is stopped, given nonsense, or short of memory.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod checkpoint;
mod corpus;
mod interrupts;
mod memory;
mod options;
mod support;
