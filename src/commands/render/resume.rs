//! `--checkpoint`, `--checkpoint-every`, `--resume`.

use super::Args;
use anyhow::Result;
use domelight::checkpoint::{self, Checkpoint, Identity};
use domelight::registry::Params;
use domelight::render::{Render, State};
use domelight::sampler::DomeSampler;
use std::path::Path;
use std::time::Instant;

/// Writes a checkpoint whenever it is time for one.
#[derive(Debug)]
pub(super) struct Keeper<'a> {
    path: Option<&'a Path>,
    every: f64,
    identity: Identity,
    last: Instant,
}

impl<'a> Keeper<'a> {
    /// The state to render from, that of `--resume` or a fresh one, and what keeps the states to come.
    pub(super) fn begin(
        args: &'a Args,
        resume: Option<Checkpoint>,
        render: &Render<'_>,
        plugins: [&Params; 3],
        sampler: &mut dyn DomeSampler,
    ) -> Result<(State, Self)> {
        let asked = args.checkpoint.is_some() || resume.is_some();
        let identity = if asked { checkpoint::identity(render, plugins) } else { Identity::new() };
        let state = match resume {
            Some(checkpoint) => checkpoint.resume(render, &identity, sampler)?,
            None => render.start(),
        };
        let keeper =
            Self { path: args.checkpoint.as_deref(), every: args.checkpoint_every, identity, last: Instant::now() };
        Ok((state, keeper))
    }

    /// Writes `state` if it is time, or the last chance.
    pub(super) fn keep(&mut self, state: &State, sampler: &dyn DomeSampler) {
        let Some(path) = self.path else { return };
        if !state.picture.stopped && self.last.elapsed().as_secs_f64() < self.every {
            return;
        }
        // A full disk costs the checkpoint, not the render; the file of the last one is still there.
        if let Err(error) = checkpoint::write(path, &self.identity, state, sampler) {
            say!("domelight: no checkpoint could be written: {error}");
        }
        self.last = Instant::now();
    }
}
