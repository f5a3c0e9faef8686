//! Decodes glTF accessors to lists of numbers, and rejects accessors whose data does not match their declaration.
//!
//! An accessor is first packed (its `count` elements without gaps, with sparse values applied), then its components are
//! decoded. All offsets are computed with checked arithmetic.

use super::buffers::GltfBuffers;
use super::document::{Accessor, Document, Sparse};
use super::get_element;
use crate::error::{Result, invalid};

// Component types of glTF.
const I8: u64 = 5120;
const U8: u64 = 5121;
const I16: u64 = 5122;
const U16: u64 = 5123;
const U32: u64 = 5125;
const F32: u64 = 5126;

/// The largest number of elements of an accessor without a buffer view, whose elements are zero except for sparse values.
const MAX_ZEROS: usize = 1 << 22;

/// The types of the components of an attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ComponentTypes {
    /// Floats, and integers as in the extension KHR_mesh_quantization.
    Quantized,
    /// Floats and normalized unsigned integers.
    UnitInterval,
    /// Unsigned integers that are not normalized.
    Indices,
    Floats,
}

impl ComponentTypes {
    const fn allow(self, component_type: u64, is_normalized: bool) -> bool {
        match self {
            Self::Quantized => matches!(component_type, F32 | I8 | U8 | I16 | U16),
            Self::UnitInterval => matches!((component_type, is_normalized), (F32, _) | (U8 | U16, true)),
            Self::Indices => matches!((component_type, is_normalized), (U8 | U16, false)),
            Self::Floats => component_type == F32,
        }
    }

    /// For an error.
    const fn list(self) -> &'static str {
        match self {
            Self::Quantized => "5126 (f32), 5120 (i8), 5121 (u8), 5122 (i16) or 5123 (u16)",
            Self::UnitInterval => "5126 (f32), or normalized 5121 (u8) or 5123 (u16)",
            Self::Indices => "5121 (u8) or 5123 (u16)",
            Self::Floats => "5126 (f32)",
        }
    }
}

/// The formats in which an attribute is accepted.
#[derive(Debug, Clone, Copy)]
pub(super) struct AttributeFormat {
    pub(super) components: ComponentTypes,
    /// The required number of elements. `None` allows any number. This is for the positions, which determine the number
    /// for the other attributes. With `None`, an accessor without a buffer view must have sparse values and at most
    /// [`MAX_ZEROS`] elements, because a large count without data could exhaust the memory.
    pub(super) count: Option<usize>,
}

/// Decodes the accessors of one document.
#[derive(Debug, Clone, Copy)]
pub(super) struct AccessorReader<'a> {
    pub(super) document: &'a Document,
    pub(super) buffers: &'a GltfBuffers<'a>,
}

impl AccessorReader<'_> {
    /// Decodes the accessor `index` to vectors of `N` floats.
    ///
    /// # Errors
    /// `Invalid` with the accessor and the field.
    pub(super) fn decode_vectors<const N: usize>(
        &self,
        index: usize,
        format: AttributeFormat,
    ) -> Result<Vec<[f32; N]>> {
        let accessor = get_element(&self.document.accessors, index, "accessor")?;
        self.decode_vectors_of(accessor, format).map_err(|error| error.prefix_field(&format!("accessors[{index}]")))
    }

    fn decode_vectors_of<const N: usize>(&self, accessor: &Accessor, format: AttributeFormat) -> Result<Vec<[f32; N]>> {
        // The accessor type with N components.
        let kind = match N {
            1..=4 => ["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1],
            _ => "MAT4",
        };
        check_kind(accessor, kind)?;
        let component_type = accessor.component_type;
        if !format.components.allow(component_type, accessor.normalized) {
            let given = format!("{component_type}, normalized: {}", accessor.normalized);
            return Err(invalid("componentType", format.components.list(), given));
        }
        if let Some(count) = format.count.filter(|count| *count != accessor.count) {
            return Err(invalid("count", format!("{count}, the number of positions"), accessor.count));
        }
        if format.count.is_none() {
            check_data(accessor)?;
        }
        let packed_bytes = self.pack_elements(accessor, N)?;
        // Components of all types are decoded to four bytes.
        self.buffers.charge_budget(4 * N as u64 * accessor.count as u64)?;
        // The value of a normalized integer, as the specification defines it.
        let value = |number: f32, full: f32| if accessor.normalized { (number / full).max(-1.0) } else { number };
        Ok(match component_type {
            I8 => group_components(packed_bytes.iter().map(|byte| value(f32::from(byte.cast_signed()), 127.0))),
            U8 => group_components(packed_bytes.iter().map(|byte| value(f32::from(*byte), 255.0))),
            I16 => group_components(
                split_components::<2>(&packed_bytes).map(|bytes| value(f32::from(i16::from_le_bytes(bytes)), 32767.0)),
            ),
            U16 => group_components(
                split_components::<2>(&packed_bytes).map(|bytes| value(f32::from(u16::from_le_bytes(bytes)), 65535.0)),
            ),
            _ => group_components(split_components::<4>(&packed_bytes).map(f32::from_le_bytes)),
        })
    }

    /// Decodes the accessor `index` to vertex indices, and checks that they are below `vertex_count`.
    ///
    /// # Errors
    /// `Invalid` with the accessor and the field.
    pub(super) fn decode_indices(&self, index: usize, vertex_count: usize) -> Result<Vec<u32>> {
        let accessor = get_element(&self.document.accessors, index, "accessor")?;
        self.decode_indices_of(accessor, vertex_count)
            .map_err(|error| error.prefix_field(&format!("accessors[{index}]")))
    }

    fn decode_indices_of(&self, accessor: &Accessor, vertex_count: usize) -> Result<Vec<u32>> {
        check_kind(accessor, "SCALAR")?;
        check_data(accessor)?;
        index_size(accessor.component_type)?;
        let packed_bytes = self.pack_elements(accessor, 1)?;
        self.buffers.charge_budget(4 * accessor.count as u64)?;
        let indices = decode_integers(&packed_bytes, accessor.component_type);
        match indices.iter().position(|index| *index as usize >= vertex_count) {
            None => Ok(indices),
            Some(element) => {
                Err(invalid(format!("element {element}"), format!("an index below {vertex_count}"), indices[element]))
            }
        }
    }

    /// Copies the accessor's elements of `components` components each without gaps, and applies its sparse values.
    fn pack_elements(&self, accessor: &Accessor, components: usize) -> Result<Vec<u8>> {
        let element_size = components * component_size(accessor.component_type);
        let total_bytes = accessor.count.checked_mul(element_size).filter(|_| accessor.count > 0);
        let total_bytes =
            total_bytes.ok_or_else(|| invalid("count", "at least 1 element of addressable size", accessor.count))?;
        let mut packed_bytes = Vec::new();
        match accessor.buffer_view {
            Some(view) => {
                let (view, stride) = self.buffers.view(view)?;
                let stride = stride.unwrap_or(element_size);
                if stride < element_size {
                    return Err(invalid("bufferView.byteStride", format!("at least {element_size}"), stride));
                }
                let elements = elements(view, accessor.byte_offset, [stride, element_size], accessor.count)?;
                self.buffers.charge_budget(total_bytes as u64)?;
                packed_bytes.reserve_exact(total_bytes);
                elements.for_each(|element| packed_bytes.extend_from_slice(element));
            }
            None => {
                self.buffers.charge_budget(total_bytes as u64)?;
                packed_bytes.resize(total_bytes, 0);
            }
        }
        if let Some(sparse) = &accessor.sparse {
            self.apply_sparse(&mut packed_bytes, sparse, element_size).map_err(|error| error.prefix_field("sparse"))?;
        }
        Ok(packed_bytes)
    }

    /// Replaces elements by the sparse values.
    fn apply_sparse(&self, packed_bytes: &mut [u8], sparse: &Sparse, element_size: usize) -> Result<()> {
        let element_count = packed_bytes.len() / element_size;
        if sparse.count == 0 || sparse.count > element_count {
            return Err(invalid("count", format!("1 to {element_count}"), sparse.count));
        }
        let bytes_per_index =
            index_size(sparse.indices.component_type).map_err(|error| error.prefix_field("indices"))?;
        let (view, _) = self.buffers.view(sparse.indices.buffer_view).map_err(|error| error.prefix_field("indices"))?;
        let index_data = elements(view, sparse.indices.byte_offset, [bytes_per_index; 2], sparse.count);
        let index_data: Vec<u8> =
            index_data.map_err(|error| error.prefix_field("indices"))?.flatten().copied().collect();
        let (view, _) = self.buffers.view(sparse.values.buffer_view).map_err(|error| error.prefix_field("values"))?;
        let values = elements(view, sparse.values.byte_offset, [element_size; 2], sparse.count);
        let mut min_element = 0;
        for (element, value) in decode_integers(&index_data, sparse.indices.component_type)
            .into_iter()
            .zip(values.map_err(|error| error.prefix_field("values"))?)
        {
            let element = element as usize;
            if element < min_element || element >= element_count {
                let expected = format!("ascending indices (next: {min_element} to {})", element_count - 1);
                return Err(invalid("indices", expected, element));
            }
            packed_bytes[element * element_size..][..element_size].copy_from_slice(value);
            min_element = element + 1;
        }
        Ok(())
    }
}

/// The bytes of `count` elements of `size` bytes at intervals of `stride` bytes, from `offset` in the buffer view.
/// `count` must be at least 1.
fn elements(
    view: &[u8],
    offset: usize,
    [stride, size]: [usize; 2],
    count: usize,
) -> Result<impl Iterator<Item = &[u8]>> {
    let end = stride.checked_mul(count - 1).and_then(|end| end.checked_add(size)?.checked_add(offset));
    if end.is_none_or(|end| end > view.len()) {
        return Err(invalid(
            "byteOffset + stride x (count - 1) + size",
            format!("at most {}, the bytes of the buffer view", view.len()),
            format!("{offset} + {stride} x ({count} - 1) + {size}"),
        ));
    }
    Ok(view[offset..].chunks(stride).take(count).map(move |element| &element[..size]))
}

/// Checks that an accessor has data of its own, and that they limit the number of its elements.
fn check_data(accessor: &Accessor) -> Result<()> {
    match (accessor.buffer_view, &accessor.sparse) {
        (Some(_), _) => Ok(()),
        (None, Some(_)) if accessor.count <= MAX_ZEROS => Ok(()),
        (None, Some(_)) => Err(invalid("count", format!("at most {MAX_ZEROS} without a bufferView"), accessor.count)),
        (None, None) => Err(invalid("bufferView", "an index or sparse values", "neither")),
    }
}

fn check_kind(accessor: &Accessor, kind: &str) -> Result<()> {
    match accessor.kind == kind {
        true => Ok(()),
        false => Err(invalid("type", kind, super::remarks::sanitize(&accessor.kind, 20))),
    }
}

/// Size of a component in bytes. `component_type` must be one of the supported types.
const fn component_size(component_type: u64) -> usize {
    match component_type {
        I8 | U8 => 1,
        I16 | U16 => 2,
        _ => 4,
    }
}

/// Size of an index in bytes.
fn index_size(component_type: u64) -> Result<usize> {
    match component_type {
        U8 | U16 | U32 => Ok(component_size(component_type)),
        _ => Err(invalid("componentType", "5121 (u8), 5123 (u16) or 5125 (u32)", component_type)),
    }
}

fn decode_integers(packed_bytes: &[u8], component_type: u64) -> Vec<u32> {
    match component_type {
        U8 => packed_bytes.iter().map(|byte| u32::from(*byte)).collect(),
        U16 => split_components::<2>(packed_bytes).map(|bytes| u32::from(u16::from_le_bytes(bytes))).collect(),
        _ => split_components::<4>(packed_bytes).map(u32::from_le_bytes).collect(),
    }
}

/// Splits packed bytes into components of `W` bytes.
fn split_components<const W: usize>(packed_bytes: &[u8]) -> impl Iterator<Item = [u8; W]> {
    packed_bytes.as_chunks::<W>().0.iter().copied()
}

fn group_components<const N: usize>(components: impl Iterator<Item = f32>) -> Vec<[f32; N]> {
    components.collect::<Vec<f32>>().as_chunks::<N>().0.to_vec()
}
