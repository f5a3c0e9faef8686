//! Parser of safetensors files. U is the tensor named `U` or the only tensor of the file, row-major, as f64, f32, f16
//! bf16 or whole numbers. The tensor `eigenvalues` (f64 or f32) is optional.

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use super::npy::entries_of_kind;
use super::{LoadedModes, NpyArray, matrix};
use crate::error::{Result, invalid};

/// The name of the tensor with the eigenvalues.
const EIGENVALUES: &str = "eigenvalues";

/// Parses U and the eigenvalues.
///
/// # Errors
/// `Invalid` if the bytes are not a safetensors file, U is missing, or a tensor has an unsupported type or shape.
pub(super) fn parse(bytes: &[u8]) -> Result<LoadedModes> {
    let safetensors =
        SafeTensors::deserialize(bytes).map_err(|error| invalid("header", "a safetensors file", error))?;
    let names: Vec<&str> = safetensors.names().into_iter().filter(|name| *name != EIGENVALUES).collect();
    let name = match names[..] {
        [name] => name,
        _ => "U",
    };
    let missing = |_| {
        let given = names.iter().take(16).copied().collect::<Vec<_>>().join(", ");
        invalid("tensor", "one tensor, or one named U", format!("{} tensors ({given})", names.len()))
    };
    let tensor = safetensors.tensor(name).map_err(missing)?;
    let array =
        NpyArray { shape: tensor.shape().to_vec(), fortran_order: false, entries: read_entries(&tensor, name)? };
    let modes = match matrix(array) {
        Err(crate::error::Error::Invalid { field, expected, given }) if field == "shape" => {
            return Err(invalid(format!("tensor '{name}': shape"), expected, given));
        }
        modes => modes?,
    };
    let eigenvalues = match safetensors.tensor(EIGENVALUES) {
        Ok(tensor) => read_eigenvalues(&tensor)?,
        Err(_) => Vec::new(),
    };
    LoadedModes::new(modes, eigenvalues)
}

fn read_entries(tensor: &TensorView<'_>, name: &str) -> Result<Vec<f32>> {
    let body = tensor.data();
    let kind = match tensor.dtype() {
        Dtype::F64 => return Ok(super::vega::read_f64_le_as_f32(body)),
        Dtype::F32 => return Ok(super::vega::read_f32_le(body)),
        // bf16 is the upper half of an f32.
        Dtype::BF16 => {
            let bf16_to_f32 = |bits: &[u8; 2]| f32::from_bits(u32::from(u16::from_le_bytes(*bits)) << 16);
            return Ok(body.as_chunks().0.iter().map(bf16_to_f32).collect());
        }
        Dtype::F16 => "f2",
        Dtype::I8 => "i1",
        Dtype::U8 => "u1",
        Dtype::I16 => "i2",
        Dtype::U16 => "u2",
        Dtype::I32 => "i4",
        Dtype::U32 => "u4",
        Dtype::I64 => "i8",
        Dtype::U64 => "u8",
        _ => "",
    };
    let entries = entries_of_kind(kind, body, |entry| entry as f32);
    entries.ok_or_else(|| {
        let field = format!("tensor '{name}': type");
        invalid(field, "F64, F32, F16, BF16 or whole numbers", format!("{:?}", tensor.dtype()))
    })
}

fn read_eigenvalues(tensor: &TensorView<'_>) -> Result<Vec<f64>> {
    match tensor.dtype() {
        Dtype::F64 => Ok(tensor.data().as_chunks().0.iter().map(|entry| f64::from_le_bytes(*entry)).collect()),
        Dtype::F32 => {
            Ok(tensor.data().as_chunks().0.iter().map(|entry| f64::from(f32::from_le_bytes(*entry))).collect())
        }
        other => Err(invalid(format!("tensor '{EIGENVALUES}': type"), "F64 or F32", format!("{other:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use safetensors::tensor::TensorView;

    use super::super::npy::f16_to_f32;
    use super::*;

    /// A file with tensors, each with its name, type, shape and data. Leaks a copy of the data, so that the tensor
    /// views can borrow it.
    fn serialize_tensors(tensors: &[(&str, Dtype, Vec<usize>, &[u8])]) -> Vec<u8> {
        let view = |(name, dtype, shape, data): &(&str, Dtype, Vec<usize>, &'static [u8])| {
            (name.to_string(), TensorView::new(*dtype, shape.clone(), data).expect("a valid tensor"))
        };
        let tensors: Vec<(&str, Dtype, Vec<usize>, &'static [u8])> = tensors
            .iter()
            .map(|(name, dtype, shape, data)| (*name, *dtype, shape.clone(), &*data.to_vec().leak()))
            .collect();
        safetensors::serialize(tensors.iter().map(view), None).expect("a serialized file")
    }

    #[test]
    fn all_entry_types_give_the_same_column() {
        let f64s: Vec<u8> = [1.0f64, -0.5, 2.0].iter().flat_map(|entry| entry.to_le_bytes()).collect();
        let f32s: Vec<u8> = [1.0f32, -0.5, 2.0].iter().flat_map(|entry| entry.to_le_bytes()).collect();
        // 1, -0.5 and 2 as binary16, then as bfloat16.
        let f16s: Vec<u8> = [0x3c00u16, 0xb800, 0x4000].iter().flat_map(|entry| entry.to_le_bytes()).collect();
        let bf16s: Vec<u8> = [0x3f80u16, 0xbf00, 0x4000].iter().flat_map(|entry| entry.to_le_bytes()).collect();
        let whole =
            parse(&serialize_tensors(&[("anything", Dtype::I8, vec![3, 1], &[1, 255, 2])])).expect("a valid file");
        assert_eq!(whole.modes.column(0), [1.0, -1.0, 2.0]);
        for (dtype, body) in [(Dtype::F64, f64s), (Dtype::F32, f32s), (Dtype::F16, f16s), (Dtype::BF16, bf16s)] {
            let modes =
                parse(&serialize_tensors(&[("anything", dtype, vec![3, 1], &body)])).expect("a valid file").modes;
            assert_eq!(modes.column(0), [1.0, -0.5, 2.0], "{dtype:?}");
        }
    }

    #[test]
    fn eigenvalues_and_n_3_r_arrays_are_read() {
        let entries: Vec<u8> = (0..12u8).flat_map(|entry| f32::from(entry).to_le_bytes()).collect();
        let values: Vec<u8> = [1.5f64, 2.5].iter().flat_map(|value| value.to_le_bytes()).collect();
        let u = ("phi", Dtype::F32, vec![2, 3, 2], &entries[..]);
        let file = |values: &[u8], count: usize| {
            parse(&serialize_tensors(&[u.clone(), (EIGENVALUES, Dtype::F64, vec![count], values)]))
        };
        let loaded = file(&values, 2).expect("a valid file");
        assert_eq!((loaded.modes.entry(1, 2, 1), &loaded.eigenvalues[..]), (11.0, &[1.5, 2.5][..]));
        let message = file(&values[..8], 1).expect_err("one eigenvalue of two").to_string();
        assert_eq!(message, "eigenvalues: expected one per mode (2), got 1");
    }

    #[test]
    fn f16_to_f32_is_exact_at_the_ends_of_the_range() {
        assert_eq!(f16_to_f32(1), 2f32.powi(-24));
        assert_eq!(f16_to_f32(0x0400), 2f32.powi(-14));
        assert_eq!(f16_to_f32(0x7bff), 65504.0);
        assert!(f16_to_f32(0xfc00) == f32::NEG_INFINITY && f16_to_f32(0x7e00).is_nan());
    }

    #[test]
    fn invalid_tensors_and_headers_are_rejected() {
        let zeros = [0; 12];
        let two_tensors = [("U", Dtype::F32, vec![3, 1], &zeros[..]), ("V", Dtype::F32, vec![3, 1], &zeros[..])];
        assert!(parse(&serialize_tensors(&two_tensors)).is_ok(), "expected the tensor U to be selected by name");
        for (bytes, start) in [
            (
                serialize_tensors(&[("a", Dtype::F32, vec![3, 1], &zeros[..]), two_tensors[1].clone()]),
                "tensor: expected one tensor, or one named U",
            ),
            (serialize_tensors(&[("U", Dtype::BOOL, vec![12, 1], &zeros[..])]), "tensor 'U': type"),
            (serialize_tensors(&[("U", Dtype::F32, vec![3], &zeros[..])]), "tensor 'U': shape"),
            (serialize_tensors(&[("U", Dtype::F32, vec![1, 3], &zeros[..])]), "modes.rows"),
            (vec![255; 64], "header: expected a safetensors file"),
            (b"\x02\0\0\0\0\0\0\0{}".to_vec(), "tensor: expected one tensor"),
            (vec![], "header: expected a safetensors file"),
        ] {
            let message = parse(&bytes).expect_err(start).to_string();
            assert!(message.starts_with(start), "{message}");
        }
    }
}
