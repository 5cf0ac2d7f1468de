//! What several tests share.
#![allow(dead_code, reason = "each test uses a part")]

pub(crate) mod accel;
pub(crate) mod render;
pub(crate) mod samplers;
