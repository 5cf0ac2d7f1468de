//! What several tests share.
pub(crate) mod accel;
pub(crate) mod formula;
pub(crate) mod pictures;
pub(crate) mod render;
pub(crate) mod samplers;
