//! Typed reading of accessors: strides, sparse overrides, normalised integers. A range is checked once, in whole,
//! when the accessor is opened; reading an element then can't fail.

use super::asset::Asset;
use crate::error::Result;
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;

/// The most elements of an accessor no byte stands behind (no buffer view: all zeros, or sparse).
const MOST_VIRTUAL: u64 = 1 << 22;

/// Elements of one type in a byte range that is known to hold them.
#[derive(Debug, Clone, Copy)]
struct Run<'a> {
    bytes: &'a [u8],
    stride: usize,
    component: ComponentType,
}

impl Run<'_> {
    /// Component `c` of element `i` as an unsigned number (negative ones wrap; none are read so).
    #[inline]
    fn integer(&self, i: usize, c: usize) -> u32 {
        let at = i * self.stride + c * self.component.size();
        let b = &self.bytes[at..];
        match self.component {
            ComponentType::U8 | ComponentType::I8 => u32::from(b[0]),
            ComponentType::U16 | ComponentType::I16 => u32::from(u16::from_le_bytes([b[0], b[1]])),
            ComponentType::U32 | ComponentType::F32 => u32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        }
    }

    /// Component `c` of element `i` as a float, integers normalised when asked for.
    #[inline]
    fn float(&self, i: usize, c: usize, normalized: bool) -> f32 {
        let bits = self.integer(i, c);
        let (value, most) = match self.component {
            ComponentType::F32 => return f32::from_bits(bits),
            ComponentType::U8 => (bits as f32, 255.0),
            ComponentType::I8 => (f32::from(bits as u8 as i8), 127.0),
            ComponentType::U16 => (bits as f32, 65535.0),
            ComponentType::I16 => (f32::from(bits as u16 as i16), 32767.0),
            ComponentType::U32 => (bits as f32, 4_294_967_295.0),
        };
        // The least signed value would be a little below −1.
        if normalized { (value / most).max(-1.0) } else { value }
    }
}

/// An accessor whose ranges have been checked.
#[derive(Debug)]
pub(super) struct Accessor<'a> {
    /// How many elements.
    pub(super) count: usize,
    /// Components an element.
    pub(super) width: usize,
    /// Whether integers stand for fractions.
    pub(super) normalized: bool,
    /// The type of a component.
    pub(super) component: ComponentType,
    /// `None`: zeros.
    dense: Option<Run<'a>>,
    /// Overridden elements in ascending order, with the position of their value in `values`.
    sparse: Vec<(u32, u32)>,
    values: Option<Run<'a>>,
}

/// Components an element; glTF pads the columns of small matrices, which no attribute we read has.
fn width(kind: Type) -> usize {
    match kind {
        Type::Scalar => 1,
        Type::Vec2 => 2,
        Type::Vec3 => 3,
        Type::Vec4 | Type::Mat2 => 4,
        Type::Mat3 => 9,
        Type::Mat4 => 16,
    }
}

impl Asset {
    /// Opens accessor `index` for `place`; `count` is how many elements there must be, when that is known.
    pub(super) fn accessor(&self, index: usize, place: &str, count: Option<usize>) -> Result<Accessor<'_>> {
        let json = self.get(&self.root.accessors, index, "accessors", place)?;
        let name = format!("accessors[{index}]");
        let component = self.checked(json.component_type, &format!("{name}.componentType"))?.0;
        let width = width(self.checked(json.type_, &format!("{name}.type"))?);
        let n = json.count.0;
        if let Some(count) = count.filter(|c| *c as u64 != n) {
            return Err(self.error(format!(
                "{name} ({place}) has {n} elements where {count} are needed; the file is damaged: export it again"
            )));
        }
        let dense = match json.buffer_view {
            Some(view) => {
                let offset = json.byte_offset.map_or(0, |o| o.0);
                Some(self.run(view.value(), offset, n, component, width, &name)?)
            }
            None if n > MOST_VIRTUAL && count.is_none() => {
                return Err(self.error(format!(
                    "{name} claims {n} elements without any data; the file is damaged: export it again"
                )));
            }
            None => None,
        };
        let mut accessor = Accessor {
            count: n as usize,
            width,
            normalized: json.normalized,
            component,
            dense,
            sparse: Vec::new(),
            values: None,
        };
        if let Some(sparse) = &json.sparse {
            let place = format!("{name}.sparse");
            let kind = match sparse.indices.component_type {
                Checked::Valid(kind) => Checked::Valid(kind.0),
                Checked::Invalid => Checked::Invalid,
            };
            let kind = self.checked(kind, &format!("{place}.indices.componentType"))?;
            let (indices, values) = (&sparse.indices, &sparse.values);
            let m = sparse.count.0;
            let where_ = self.run(indices.buffer_view.value(), indices.byte_offset.0, m, kind, 1, &place)?;
            let what = self.run(values.buffer_view.value(), values.byte_offset.0, m, component, width, &place)?;
            for k in 0..m as usize {
                let i = where_.integer(k, 0);
                if u64::from(i) >= n {
                    return Err(self
                        .error(format!("{place} overrides element {i} of {n}; the file is damaged: export it again")));
                }
                accessor.sparse.push((i, k as u32));
            }
            // Ascending by the specification; sorted here so that a search can rely on it. A later value wins.
            accessor.sparse.sort_by_key(|&(i, k)| (i, std::cmp::Reverse(k)));
            accessor.sparse.dedup_by_key(|(i, _)| *i);
            accessor.values = Some(what);
        }
        Ok(accessor)
    }

    /// Checks that `count` elements lie within a buffer view.
    fn run(
        &self,
        view: usize,
        offset: u64,
        count: u64,
        component: ComponentType,
        width: usize,
        place: &str,
    ) -> Result<Run<'_>> {
        let (bytes, stride) = self.view(view, place)?;
        let size = component.size() * width;
        let stride = if stride == 0 { size } else { stride };
        if stride < size {
            return Err(self.error(format!(
                "{place} has elements of {size} bytes every {stride} bytes; the file is damaged: export it again"
            )));
        }
        let last = count.saturating_sub(1).checked_mul(stride as u64).and_then(|s| s.checked_add(offset));
        let end = last.and_then(|l| l.checked_add(if count == 0 { 0 } else { size as u64 }));
        if end.is_none_or(|end| end > bytes.len() as u64) {
            return Err(self.error(format!(
                "{place} needs {count} elements of {size} bytes from byte {offset}, but bufferViews[{view}] has {} \
                 bytes; the file is damaged or cut short: export or copy it again",
                bytes.len()
            )));
        }
        Ok(Run { bytes: &bytes[offset as usize..], stride, component })
    }
}

impl Accessor<'_> {
    /// The run and the place in it where element `i` is.
    #[inline]
    fn locate(&self, i: usize) -> (Option<&Run<'_>>, usize) {
        if !self.sparse.is_empty()
            && let Ok(found) = self.sparse.binary_search_by_key(&(i as u32), |s| s.0)
        {
            return (self.values.as_ref(), self.sparse[found].1 as usize);
        }
        (self.dense.as_ref(), i)
    }

    /// Element `i` as floats; components the accessor does not have are `missing`.
    #[inline]
    pub(super) fn floats<const N: usize>(&self, i: usize, missing: f32) -> [f32; N] {
        let (run, at) = self.locate(i);
        std::array::from_fn(|c| match run {
            _ if c >= self.width => missing,
            Some(run) => run.float(at, c, self.normalized),
            None => 0.0,
        })
    }

    /// Element `i` as whole numbers; components the accessor does not have are 0.
    #[inline]
    pub(super) fn integers<const N: usize>(&self, i: usize) -> [u32; N] {
        let (run, at) = self.locate(i);
        std::array::from_fn(|c| match run {
            Some(run) if c < self.width => run.integer(at, c),
            _ => 0,
        })
    }

    /// Whether components are whole numbers without a sign.
    pub(super) fn is_integer(&self) -> bool {
        matches!(self.component, ComponentType::U8 | ComponentType::U16 | ComponentType::U32)
    }
}
