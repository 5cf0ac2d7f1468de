//! Channels of an EXR file as planes of f32: the one way in for domes and for images to compare.
//!
//! The crate `exr` decodes the blocks; this file keeps a hostile or damaged file from taking all memory or ending the
//! process: the header is judged before anything of the image's size is allocated, blocks are decoded where a panic is
//! caught, and every message says what to do.

use crate::pages;
use exr::block::chunk::{Chunk, CompressedBlock};
use exr::block::reader::{ChunksReader, Reader};
use exr::block::{self, UncompressedBlock};
use exr::error::Error as ExrError;
use exr::math::Vec2;
use exr::meta::attribute::{Compression, SampleType};
use exr::meta::header::Header;
use exr::meta::{BlockDescription, MetaData};
use exr::prelude::f16;
use rayon::prelude::*;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// The most texels across or down, and in all, that any image may declare.
pub(crate) const MAX_SIDE: usize = 65_536;
/// See [`MAX_SIDE`]: 2²⁸ texels are 3 GB of RGB.
pub(crate) const MAX_TEXELS: usize = 1 << 28;

/// The first bytes of every EXR file.
pub(crate) const MAGIC: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];

const DAMAGED: &str = "the file is damaged or incomplete; fetch or export it again";

/// What decoding gives: a value, or a message for people that a caller puts beside the file's name.
pub(crate) type Decoded<T> = Result<T, String>;

/// An opened EXR file whose header has been read and judged.
#[derive(Debug)]
pub(crate) struct Planes {
    reader: Reader<BufReader<File>>,
}

/// Opens a regular file that is not empty, and says how many bytes it has. Directories and FIFOs are refused unopened
/// (opening a FIFO would wait for a writer).
pub(crate) fn open_regular(path: &Path) -> Decoded<(File, u64)> {
    let meta = std::fs::metadata(path).map_err(|e| format!("{e}; check the path"))?;
    if meta.is_dir() {
        return Err("this is a directory; name an image file in it".into());
    }
    if !meta.is_file() {
        return Err("this is not a regular file; save the image to disk and name that file".into());
    }
    if meta.len() == 0 {
        return Err("the file is empty; fetch or export it again".into());
    }
    let file = File::open(path).map_err(|e| format!("{e}; check the file's permissions"))?;
    Ok((file, meta.len()))
}

/// Refuses sizes no image should have, before memory is asked for.
pub(crate) fn check_size(width: usize, height: usize) -> Decoded<()> {
    if width == 0 || height == 0 {
        return Err(format!("the image has no pixels ({width}×{height}); export it again"));
    }
    if width > MAX_SIDE || height > MAX_SIDE || width.saturating_mul(height) > MAX_TEXELS {
        return Err(format!(
            "the file declares {width}×{height} pixels, beyond the limit of {MAX_SIDE} a side and 2^28 in all; \
             scale the image down (or the file is damaged)"
        ));
    }
    Ok(())
}

impl Planes {
    /// Reads and judges the header of `file`, which is `bytes` long.
    pub(crate) fn open(mut file: File, bytes: u64) -> Decoded<Self> {
        let mut start = [0; 8];
        let got = file.read(&mut start).and_then(|n| file.rewind().map(|()| n)).map_err(|e| e.to_string())?;
        if got < 8 || start[..4] != MAGIC {
            return Err("this is not an EXR file; name one, or re-save the image as EXR".into());
        }
        if start[5] & 0b1000 != 0 {
            return Err(
                "the file holds deep data (several samples a pixel); flatten it and save it as a flat EXR".into()
            );
        }
        let reader = guarded(|| block::read(BufReader::new(file), false))?;
        for header in reader.headers() {
            judge(header, bytes)?;
        }
        Ok(Self { reader })
    }

    /// One header a part.
    pub(crate) fn headers(&self) -> &[Header] {
        self.reader.headers()
    }

    /// Decodes channels of the largest resolution level: a plane of width × height values for each (part, channel).
    pub(crate) fn decode(self, wanted: &[(usize, usize)]) -> Decoded<Vec<Vec<f32>>> {
        let mut planes = Vec::with_capacity(wanted.len());
        for &(part, channel) in wanted {
            let header = &self.reader.headers()[part];
            // The crate lays lines out as if every channel had every pixel.
            if header.channels.list.iter().any(|c| c.sampling != Vec2(1, 1)) {
                let name = &header.channels.list[channel].name;
                return Err(format!(
                    "channel {name} lies beside subsampled channels (luminance-chroma); re-save the image as plain RGB"
                ));
            }
            planes.push(zeros(header.layer_size.area())?);
        }
        let mut chunks = guarded(|| {
            self.reader.filter_chunks(false, |_, tile, index| {
                tile.level_index == Vec2(0, 0) && wanted.iter().any(|(part, _)| *part == index.layer)
            })
        })?;
        let meta = chunks.meta_data().clone();
        let mut batch = Vec::new();
        loop {
            batch.clear();
            let end = guarded(|| fill(&mut chunks, &mut batch))?;
            // Not the crate's own thread pool: a panic there ends the process, here it comes back to be caught.
            let blocks = guarded(|| {
                let decode = |chunk: Chunk| {
                    vet(&chunk, &meta)?;
                    UncompressedBlock::decompress_chunk(chunk, &meta, false)
                };
                std::mem::take(&mut batch).into_par_iter().map(decode).collect::<Result<Vec<_>, _>>()
            })?;
            guarded(|| {
                blocks.iter().try_for_each(|block| place(block, &meta, wanted, &mut planes)).map_err(ExrError::Invalid)
            })?;
            if end {
                return Ok(planes);
            }
        }
    }
}

/// Reads compressed chunks up to some megabytes; whether these were the last.
fn fill(chunks: &mut impl ChunksReader, batch: &mut Vec<Chunk>) -> Result<bool, ExrError> {
    while batch.len() < 64 {
        match chunks.read_next_chunk() {
            Some(chunk) => batch.push(chunk?),
            None => return Ok(true),
        }
    }
    Ok(false)
}

/// Refuses a DWA chunk that asks for absurd amounts: the crate takes the eleven 64-bit numbers at its start at their word
/// and would end the process asking for terabytes.
fn vet(chunk: &Chunk, meta: &MetaData) -> Result<(), ExrError> {
    let Some(header) = meta.headers.get(chunk.layer_index) else { return Ok(()) };
    let bytes = match &chunk.compressed_block {
        CompressedBlock::Tile(tile) => &tile.compressed_pixels_le,
        CompressedBlock::ScanLine(lines) => &lines.compressed_pixels_le,
        _ => return Ok(()),
    };
    if !matches!(header.compression, Compression::DWAA(_) | Compression::DWAB(_)) {
        return Ok(());
    }
    let place = header.get_block_data_indices(&chunk.compressed_block)?;
    let area = header.get_absolute_block_pixel_coordinates(place)?.size.area();
    if bytes.len() == area.saturating_mul(header.channels.bytes_per_pixel) {
        return Ok(()); // stored as it is
    }
    // Sizes in bytes and counts of 16-bit values, padded to blocks of 8 × 8: sixteen times the raw size is generous.
    let limit = 16 * raw_bytes(header) as u64 + 65_536;
    let (words, _) = bytes.as_chunks::<8>();
    // The first word is a version, the last a method.
    if words.iter().take(10).skip(1).any(|word| u64::from_le_bytes(*word) > limit) {
        return Err(ExrError::Invalid("DWA chunk sizes".into()));
    }
    Ok(())
}

/// Bytes of a whole block, not compressed.
fn raw_bytes(header: &Header) -> usize {
    let Vec2(width, height) = header.max_block_pixel_size();
    width.saturating_mul(height).saturating_mul(header.channels.bytes_per_pixel)
}

/// Copies a decoded block's lines to the planes that want them.
fn place(
    block: &UncompressedBlock,
    meta: &MetaData,
    wanted: &[(usize, usize)],
    planes: &mut [Vec<f32>],
) -> Result<(), std::borrow::Cow<'static, str>> {
    let part = block.index.layer;
    let header = &meta.headers[part];
    if block.index.level != Vec2(0, 0) {
        return Ok(());
    }
    for line in block.lines(&header.channels) {
        let at = line.location;
        for (_, plane) in wanted.iter().zip(planes.iter_mut()).filter(|(w, _)| **w == (part, at.channel)) {
            let start = at.position.1 * header.layer_size.0 + at.position.0;
            let target = plane.get_mut(start..start + at.sample_count).ok_or("a block lies outside the image")?;
            // Bytes are in the machine's own order here.
            match header.channels.list[at.channel].sample_type {
                SampleType::F32 => {
                    let (values, _) = line.value.as_chunks::<4>();
                    target.iter_mut().zip(values).for_each(|(t, v)| *t = f32::from_ne_bytes(*v));
                }
                SampleType::F16 => {
                    let (values, _) = line.value.as_chunks::<2>();
                    target.iter_mut().zip(values).for_each(|(t, v)| *t = f16::from_ne_bytes(*v).to_f32());
                }
                SampleType::U32 => {
                    let (values, _) = line.value.as_chunks::<4>();
                    target.iter_mut().zip(values).for_each(|(t, v)| *t = u32::from_ne_bytes(*v) as f32);
                }
            }
        }
    }
    Ok(())
}

/// Refuses headers whose blocks the file can't hold or memory should not.
fn judge(header: &Header, bytes: u64) -> Decoded<()> {
    let Vec2(width, height) = header.layer_size;
    check_size(width, height)?;
    if let BlockDescription::Tiles(tiles) = header.blocks {
        check_size(tiles.tile_size.0, tiles.tile_size.1).map_err(|_| format!("its tile size is absurd: {DAMAGED}"))?;
    }
    // Each block has an entry of 8 bytes in a table and as many of its own at the least.
    if (header.chunk_count as u64).saturating_mul(16) > bytes {
        return Err(format!("{width}×{height} pixels can't be in {bytes} bytes: {DAMAGED}"));
    }
    if raw_bytes(header) > 1 << 31 {
        return Err("a single block of it takes more than 2 GB; re-save it in scan lines or smaller tiles".into());
    }
    Ok(())
}

/// `count` zeros, or an error where there is no memory for them.
pub(crate) fn zeros(count: usize) -> Decoded<Vec<f32>> {
    if !pages::are_free(count.saturating_mul(size_of::<f32>())) {
        return Err(format!("no memory for {count} texels; scale the image down"));
    }
    // Fresh pages, touched only as they are filled.
    Ok(vec![0.0; count])
}

/// Runs a piece of the decoder; an error or a panic of it (a damaged file may bring one about) is a message.
fn guarded<T>(run: impl FnOnce() -> Result<T, ExrError>) -> Decoded<T> {
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(ExrError::NotSupported(what))) => {
            Err(format!("{what}: not supported; re-save it as a flat EXR with ZIP compression"))
        }
        Ok(Err(ExrError::Io(error))) => Err(error.to_string()),
        Ok(Err(error)) => Err(format!("{error}: {DAMAGED}")),
        Err(_) => Err(DAMAGED.to_owned()),
    }
}
