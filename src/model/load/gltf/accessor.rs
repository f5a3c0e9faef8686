//! Decodes glTF accessors to lists of numbers, and rejects accessors whose data does not match their declaration.
//!
//! An accessor is first packed (its `count` elements without gaps, with sparse values applied), then its components are
//! decoded. All offsets are computed with checked arithmetic.

use super::buffers::GltfBuffers;
use super::document::{Accessor, Document, Sparse};
use super::get_element;
use crate::error::{Result, invalid};

const U8: u64 = 5121;
const U16: u64 = 5123;
const U32: u64 = 5125;
const F32: u64 = 5126;

/// The accepted formats of an attribute.
#[derive(Debug, Clone, Copy)]
pub(super) struct AttributeFormat {
    /// Whether normalized unsigned integers are accepted too.
    pub(super) integers: bool,
    /// The number of elements, if another accessor already determines it. Only then may the data be omitted (all zeros,
    /// or zeros with sparse values): otherwise a count without data could request any amount of memory.
    pub(super) count: Option<usize>,
}

/// Decodes the accessors of one document.
#[derive(Debug, Clone, Copy)]
pub(super) struct AccessorReader<'a> {
    pub(super) document: &'a Document,
    pub(super) bytes: &'a GltfBuffers<'a>,
}

impl AccessorReader<'_> {
    /// Elements of `N` floats.
    ///
    /// # Errors
    /// `Invalid` with the accessor and the field.
    pub(super) fn vectors<const N: usize>(&self, index: usize, form: AttributeFormat) -> Result<Vec<[f32; N]>> {
        let accessor = get_element(&self.document.accessors, index, "accessor")?;
        self.vectors_of(accessor, form).map_err(|error| error.prefix_field(&format!("accessors[{index}]")))
    }

    fn vectors_of<const N: usize>(&self, accessor: &Accessor, form: AttributeFormat) -> Result<Vec<[f32; N]>> {
        expect_kind(accessor, ["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1])?;
        let component = accessor.component_type;
        let integer = form.integers && accessor.normalized && matches!(component, U8 | U16);
        if component != F32 && !integer {
            let also = if form.integers { ", or normalized 5121 (u8) or 5123 (u16)" } else { "" };
            let given = format!("{component}, normalized: {}", accessor.normalized);
            return Err(invalid("componentType", format!("{F32} (f32){also}"), given));
        }
        if let Some(count) = form.count.filter(|count| *count != accessor.count) {
            return Err(invalid("count", format!("{count}, as many as positions"), accessor.count));
        }
        if form.count.is_none() && accessor.buffer_view.is_none() {
            return Err(invalid("bufferView", "an index", "none"));
        }
        let packed = self.packed(accessor, N)?;
        // Four bytes per component whatever its type in the file.
        self.bytes.charge_budget(4 * N as u64 * accessor.count as u64)?;
        Ok(match component {
            U8 => grouped(packed.iter().map(|byte| f32::from(*byte) / 255.0)),
            U16 => grouped(words::<2>(&packed).map(|word| f32::from(u16::from_le_bytes(word)) / 65535.0)),
            _ => grouped(words::<4>(&packed).map(f32::from_le_bytes)),
        })
    }

    /// Indices, each below `vertices`.
    ///
    /// # Errors
    /// `Invalid` with the accessor and the field.
    pub(super) fn indices(&self, index: usize, vertices: usize) -> Result<Vec<u32>> {
        let accessor = get_element(&self.document.accessors, index, "accessor")?;
        self.indices_of(accessor, vertices).map_err(|error| error.prefix_field(&format!("accessors[{index}]")))
    }

    fn indices_of(&self, accessor: &Accessor, vertices: usize) -> Result<Vec<u32>> {
        expect_kind(accessor, "SCALAR")?;
        if accessor.buffer_view.is_none() {
            return Err(invalid("bufferView", "an index", "none"));
        }
        index_size(accessor.component_type)?;
        let packed = self.packed(accessor, 1)?;
        self.bytes.charge_budget(4 * accessor.count as u64)?;
        let indices = integers(&packed, accessor.component_type);
        match indices.iter().position(|index| *index as usize >= vertices) {
            None => Ok(indices),
            Some(get_element) => Err(invalid(
                format!("element {get_element}"),
                format!("an index below {vertices}"),
                indices[get_element],
            )),
        }
    }

    /// The accessor's elements of `components` components each, without gaps.
    fn packed(&self, accessor: &Accessor, components: usize) -> Result<Vec<u8>> {
        let size = components * component_size(accessor.component_type);
        let total = accessor.count.checked_mul(size).filter(|_| accessor.count > 0);
        let total = total.ok_or_else(|| invalid("count", "a number of elements from 1 on", accessor.count))?;
        let mut packed = Vec::new();
        match accessor.buffer_view {
            Some(view) => {
                let (view, stride) = self.bytes.view(view)?;
                let stride = stride.unwrap_or(size);
                if stride < size {
                    return Err(invalid("bufferView.byteStride", format!("at least {size}"), stride));
                }
                let elements = elements(view, accessor.byte_offset, [stride, size], accessor.count)?;
                self.bytes.charge_budget(total as u64)?;
                packed.reserve_exact(total);
                elements.for_each(|element| packed.extend_from_slice(element));
            }
            None => {
                self.bytes.charge_budget(total as u64)?;
                packed.resize(total, 0);
            }
        }
        if let Some(sparse) = &accessor.sparse {
            self.apply_sparse(&mut packed, sparse, size).map_err(|error| error.prefix_field("sparse"))?;
        }
        Ok(packed)
    }

    /// Replaces elements by the sparse values.
    fn apply_sparse(&self, packed: &mut [u8], sparse: &Sparse, size: usize) -> Result<()> {
        let count = packed.len() / size;
        if sparse.count == 0 || sparse.count > count {
            return Err(invalid("count", format!("1 to {count}"), sparse.count));
        }
        let width = index_size(sparse.indices.component_type).map_err(|error| error.prefix_field("indices"))?;
        let (view, _) = self.bytes.view(sparse.indices.buffer_view).map_err(|error| error.prefix_field("indices"))?;
        let places = elements(view, sparse.indices.byte_offset, [width; 2], sparse.count);
        let places: Vec<u8> = places.map_err(|error| error.prefix_field("indices"))?.flatten().copied().collect();
        let (view, _) = self.bytes.view(sparse.values.buffer_view).map_err(|error| error.prefix_field("values"))?;
        let values = elements(view, sparse.values.byte_offset, [size; 2], sparse.count);
        let mut least = 0;
        for (place, value) in integers(&places, sparse.indices.component_type)
            .into_iter()
            .zip(values.map_err(|error| error.prefix_field("values"))?)
        {
            let place = place as usize;
            if place < least || place >= count {
                return Err(invalid("indices", format!("ascending indices, here {least} to {}", count - 1), place));
            }
            packed[place * size..][..size].copy_from_slice(value);
            least = place + 1;
        }
        Ok(())
    }
}

/// `count` (at least one) elements of `size` bytes at intervals of `stride` bytes.
fn elements(
    view: &[u8],
    offset: usize,
    [stride, size]: [usize; 2],
    count: usize,
) -> Result<impl Iterator<Item = &[u8]>> {
    let reach = stride.checked_mul(count - 1).and_then(|reach| reach.checked_add(size)?.checked_add(offset));
    if reach.is_none_or(|reach| reach > view.len()) {
        return Err(invalid(
            "byteOffset + stride x (count - 1) + size",
            format!("at most {}, the bytes of the buffer view", view.len()),
            format!("{offset} + {stride} x ({count} - 1) + {size}"),
        ));
    }
    Ok(view[offset..].chunks(stride).take(count).map(move |element| &element[..size]))
}

fn expect_kind(accessor: &Accessor, kind: &str) -> Result<()> {
    match accessor.kind == kind {
        true => Ok(()),
        false => Err(invalid("type", kind, super::warnings::sanitize(&accessor.kind, 20))),
    }
}

/// Size of a component in bytes. The type must have been checked.
const fn component_size(component: u64) -> usize {
    match component {
        U8 => 1,
        U16 => 2,
        _ => 4,
    }
}

fn index_size(component: u64) -> Result<usize> {
    match component {
        U8 | U16 | U32 => Ok(component_size(component)),
        _ => Err(invalid("componentType", "5121 (u8), 5123 (u16) or 5125 (u32)", component)),
    }
}

fn integers(packed: &[u8], component: u64) -> Vec<u32> {
    match component {
        U8 => packed.iter().map(|byte| u32::from(*byte)).collect(),
        U16 => words::<2>(packed).map(|word| u32::from(u16::from_le_bytes(word))).collect(),
        _ => words::<4>(packed).map(u32::from_le_bytes).collect(),
    }
}

fn words<const W: usize>(packed: &[u8]) -> impl Iterator<Item = [u8; W]> {
    packed.as_chunks::<W>().0.iter().copied()
}

fn grouped<const N: usize>(numbers: impl Iterator<Item = f32>) -> Vec<[f32; N]> {
    let flat: Vec<f32> = numbers.collect();
    flat.as_chunks::<N>().0.to_vec()
}
