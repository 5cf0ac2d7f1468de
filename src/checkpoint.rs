//! A render between two passes, in a file: what goes on from there gives the very image of a render that never stopped.
//!
//! It holds the film's sums, the counts, how many passes are done and what the sampler has learned. The schedule and all
//! random numbers are functions of the options, which are kept too, by name: a checkpoint of another render is refused.
//!
//! Layout: eight bytes of name and version, the header's length (u64), the header (JSON), the film, the sampler, SHA-256
//! of all that. Numbers are in the machine's own byte order: the image is the same bit for bit on the same machine only.

use crate::error::{Error, Result};
use crate::hash::hex;
use crate::output::write_atomically;
use crate::registry::Params;
use crate::render::{Counts, Render, Settings, State};
use crate::sampler::DomeSampler;
use crate::scene::{Mesh, Scene};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// What the file begins with; the last byte is the version.
const MAGIC: [u8; 8] = *b"DOMELCP\x0e";

/// Bytes of the hash at the end.
const HASH: u64 = 32;

/// The most bytes a header may claim.
const MOST_HEADER: u64 = 1 << 20;

/// What an image is a function of: names and values.
pub type Identity = Vec<(String, String)>;

#[derive(Debug, Serialize, Deserialize)]
struct Header {
    identity: Identity,
    passes: u32,
    spp: u32,
    seconds: f64,
    counts: Counts,
    /// The bits of [`Counts::max_weight`], which JSON can't hold when it is infinite.
    max_weight: u32,
}

/// What the render's image is a function of. `plugins` are accelerator, sampler and integrator with all options.
pub fn identity(render: &Render<'_>, plugins: [&Params; 3]) -> Identity {
    // Threads, tiles and limits of time change nothing in a pass.
    let Settings { size, crop, spp, rays, camera_rays, seed, tile: _, filter, background, aovs, variance, time: _ } =
        render.settings;
    let mut dome = Sha256::new();
    dome.update(format!("{:?}", render.dome.grid));
    dome.update(bytemuck::cast_slice(&render.dome.texels));
    let [accel, sampler, integrator] = plugins.map(Params::to_string);
    [
        ("version of domelight", env!("CARGO_PKG_VERSION").to_owned()),
        ("scene", fingerprint(render.scene)),
        ("dome", hex(&dome.finalize())),
        ("camera", format!("{:?}", render.view)),
        ("size", format!("{}x{}", size[0], size[1])),
        ("crop", crop.map(|v| v.to_string()).join(",")),
        ("spp", spp.to_string()),
        ("rays", rays.to_string()),
        ("camera rays", camera_rays.map_or("auto".to_owned(), |n| n.to_string())),
        ("seed", seed.to_string()),
        ("filter", format!("{filter:?}")),
        ("background", format!("{background:?}")),
        ("layers", if aovs { "some" } else { "none" }.to_owned()),
        ("variance", if variance { "on" } else { "off" }.to_owned()),
        ("accelerator", accel),
        ("sampler", sampler),
        ("integrator", integrator),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .to_vec()
}

/// A hash of all that is rendered, wherever it was loaded from.
fn fingerprint(scene: &Scene) -> String {
    let mut hash = Sha256::new();
    for Mesh { positions, indices, normals, tangents, uvs, colors, material } in &scene.meshes {
        hash.update(format!("{} {} {material}", positions.len(), indices.len()));
        hash.update(bytemuck::cast_slice(positions));
        hash.update(bytemuck::cast_slice(indices));
        hash.update(bytemuck::cast_slice(normals));
        hash.update(bytemuck::cast_slice(tangents));
        uvs.iter().for_each(|uvs| hash.update(bytemuck::cast_slice(uvs)));
        hash.update(bytemuck::cast_slice(colors));
    }
    for texture in &scene.textures {
        hash.update(format!("{} {:?} {} {}", texture.width, texture.wrap, texture.srgb, texture.nearest));
        hash.update(bytemuck::cast_slice(&texture.texels));
    }
    // Debug output of floats is exact.
    hash.update(format!("{:?} {:?}", scene.materials, scene.instances));
    hex(&hash.finalize())
}

/// Writes a checkpoint, whole or not at all.
pub fn write(path: &Path, identity: &Identity, state: &State, sampler: &dyn DomeSampler) -> Result<()> {
    let counts = state.picture.counts;
    let header = Header {
        identity: identity.clone(),
        passes: state.passes,
        spp: state.picture.spp,
        seconds: state.seconds,
        counts: Counts { max_weight: 0.0, ..counts },
        max_weight: counts.max_weight.to_bits(),
    };
    write_atomically(path, |file| {
        let header = serde_json::to_vec(&header)?;
        let mut out = BufWriter::with_capacity(1 << 16, Hashing { to: file, hash: Sha256::new() });
        out.write_all(&MAGIC)?;
        out.write_all(&(header.len() as u64).to_ne_bytes())?;
        out.write_all(&header)?;
        state.save(&mut out)?;
        sampler.save(&mut out)?;
        let Hashing { to, hash } = out.into_inner().map_err(io::IntoInnerError::into_error)?;
        to.write_all(&hash.finalize())
    })
}

/// Hashes what goes by.
struct Hashing<W> {
    to: W,
    hash: Sha256,
}

impl<W: Write> Write for Hashing<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.to.write(bytes)?;
        self.hash.update(&bytes[..count]);
        Ok(count)
    }
    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// A checkpoint that is whole.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    header: Header,
    /// Film and sampler.
    body: io::Take<BufReader<File>>,
}

impl Checkpoint {
    /// Opens a checkpoint and makes sure that it is whole.
    pub fn open(path: &Path) -> Result<Self> {
        let refuse = |message: &str| Error::checkpoint(path, message);
        let damaged = || refuse("the checkpoint is cut short or damaged; render without --resume, or from another one");
        let io = |e: io::Error| match e.kind() {
            io::ErrorKind::UnexpectedEof => damaged(),
            _ => Error::io(path, e),
        };
        // Opening a pipe would wait for ever.
        let meta = std::fs::metadata(path).map_err(io)?;
        if !meta.is_file() {
            return Err(refuse("this is not a file; name one that --checkpoint has written"));
        }
        let length = meta.len();
        let mut file = BufReader::with_capacity(1 << 16, File::open(path).map_err(io)?);
        let mut magic = [0; MAGIC.len()];
        file.read_exact(&mut magic).map_err(io)?;
        if magic[..7] != MAGIC[..7] {
            return Err(refuse("this is not a checkpoint; name a file that --checkpoint has written"));
        }
        if magic != MAGIC {
            return Err(refuse("this checkpoint is of another version of domelight; go on with that, or render anew"));
        }
        file.rewind().map_err(io)?;
        let hashed = length.checked_sub(HASH).ok_or_else(damaged)?;
        let mut all = Hashing { to: io::sink(), hash: Sha256::new() };
        io::copy(&mut (&mut file).take(hashed), &mut all).map_err(io)?;
        let mut stored = [0; HASH as usize];
        file.read_exact(&mut stored).map_err(io)?;
        if all.hash.finalize()[..] != stored {
            return Err(damaged());
        }
        file.seek(SeekFrom::Start(MAGIC.len() as u64)).map_err(io)?;
        let mut size = [0; 8];
        file.read_exact(&mut size).map_err(io)?;
        let size = Some(u64::from_ne_bytes(size)).filter(|size| *size <= MOST_HEADER).ok_or_else(damaged)?;
        let body = hashed.checked_sub(MAGIC.len() as u64 + 8 + size).ok_or_else(damaged)?;
        let header = serde_json::from_reader((&mut file).take(size)).map_err(|_| damaged())?;
        Ok(Self { path: path.to_owned(), header, body: file.take(body) })
    }

    /// The state of a render that is what the checkpoint's was; its `sampler`, fresh so far, learns what that had learned.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] names every option in which the two differ.
    pub fn resume(mut self, render: &Render<'_>, identity: &Identity, sampler: &mut dyn DomeSampler) -> Result<State> {
        let differences = self.differences(identity);
        if !differences.is_empty() {
            return Err(Error::checkpoint(
                &self.path,
                format!(
                    "the checkpoint is of another render: {}; go on with what it was made with, or render without \
                     --resume",
                    differences.join("; ")
                ),
            ));
        }
        let mut state = render.start();
        let read = state.restore(&mut self.body).and_then(|()| sampler.restore(&mut self.body));
        if read.is_err() || self.body.limit() != 0 {
            let message = "the checkpoint's data is of another size than this render's; render without --resume";
            return Err(Error::checkpoint(&self.path, message));
        }
        let Header { passes, spp, seconds, counts, max_weight, .. } = self.header;
        state.picture.spp = spp;
        state.picture.counts = Counts { max_weight: f32::from_bits(max_weight), ..counts };
        (state.passes, state.seconds) = (passes, seconds);
        Ok(state)
    }

    fn differences(&self, identity: &Identity) -> Vec<String> {
        let theirs = |name: &String| self.header.identity.iter().find(|(n, _)| n == name).map(|(_, value)| value);
        let differing = identity.iter().filter(|(name, value)| theirs(name) != Some(value));
        differing
            .map(|(name, value)| match name.as_str() {
                "scene" | "dome" | "camera" => format!("another {name}"),
                _ => format!("{name} {} instead of {value}", theirs(name).map_or("unknown", String::as_str)),
            })
            .collect()
    }
}
