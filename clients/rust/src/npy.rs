//! Writes NumPy files of f32 rows incrementally. The header reserves space for the largest number of rows and is
//! rewritten when the number is known.

use std::fs::File;
use std::io::{BufWriter, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// The start of a file of format version 1.0, which stores the length of the rest of the header as u16.
const MAGIC: &[u8] = b"\x93NUMPY\x01\x00";

/// The format pads the header with spaces and a newline, so that the data starts at a multiple of 64 bytes.
const ALIGNMENT: usize = 64;

/// Writer of a `.npy` file of shape rows x `shape`, little-endian f32, C order.
pub struct Writer {
    path: PathBuf,
    file: BufWriter<File>,
    shape: Vec<usize>,
    header_bytes: usize,
    rows: u64,
}

impl Writer {
    /// Creates the file; `shape` is the shape of one row.
    ///
    /// # Errors
    /// `File` if it cannot be written, or if the shape has so many axes that it exceeds the header of version 1.0.
    pub fn create(path: &Path, shape: &[usize]) -> Result<Self> {
        let header_bytes = header_bytes(shape);
        if header_bytes - MAGIC.len() - 2 > usize::from(u16::MAX) {
            let reason = format!("expected a shape that fits a NumPy 1.0 header, got {} axes", shape.len());
            return Err(Error::file(path, reason));
        }
        let file = File::create(path).map_err(|fault| Error::file(path, fault))?;
        let (path, file) = (path.to_owned(), BufWriter::new(file));
        let mut writer = Self { path, file, shape: shape.to_vec(), header_bytes, rows: 0 };
        writer.put_header()?;
        Ok(writer)
    }

    /// Adds one row.
    ///
    /// # Errors
    /// `File` if its length does not match the shape, or if it cannot be written.
    pub fn row(&mut self, numbers: &[f32]) -> Result<()> {
        let expected: usize = self.shape.iter().product();
        if numbers.len() != expected {
            let reason = format!("expected rows of {expected} numbers, got {}", numbers.len());
            return Err(Error::file(&self.path, reason));
        }
        self.rows += 1;
        self.put(bytemuck::cast_slice(numbers))
    }

    /// Writes the number of rows into the header and closes the file.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn finish(mut self) -> Result<u64> {
        self.file.seek(SeekFrom::Start(0)).map_err(|fault| Error::file(&self.path, fault))?;
        self.put_header()?;
        self.file.flush().map_err(|fault| Error::file(&self.path, fault))?;
        Ok(self.rows)
    }

    /// Writes magic, version, length, dictionary, padding and newline: `header_bytes` bytes for every number of rows.
    fn put_header(&mut self) -> Result<()> {
        let length = self.header_bytes - MAGIC.len() - 2;
        let mut header = MAGIC.to_vec();
        header.extend((length as u16).to_le_bytes());
        header.extend(dictionary(self.rows, &self.shape).into_bytes());
        header.resize(self.header_bytes - 1, b' ');
        header.push(b'\n');
        self.put(&header)
    }

    fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(|fault| Error::file(&self.path, fault))
    }
}

/// Size of the header with the largest number of rows; at least 128 bytes.
fn header_bytes(shape: &[usize]) -> usize {
    let bytes = MAGIC.len() + 2 + dictionary(u64::MAX, shape).len() + 1;
    bytes.next_multiple_of(ALIGNMENT).max(2 * ALIGNMENT)
}

fn dictionary(rows: u64, shape: &[usize]) -> String {
    let shape: String = shape.iter().map(|size| format!(" {size},")).collect();
    format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows},{shape}), }}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(shape: &[usize], rows: &[&[f32]]) -> Vec<u8> {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("rows.npy");
        let mut writer = Writer::create(&path, shape).expect("creates");
        rows.iter().for_each(|row| writer.row(row).expect("fits"));
        assert_eq!(writer.finish().expect("closes"), rows.len() as u64);
        std::fs::read(&path).expect("reads")
    }

    /// Splits a file into the text of its header and its data by the length that the header states.
    fn parsed(file: &[u8]) -> (&str, &[u8]) {
        let length = usize::from(u16::from_le_bytes([file[8], file[9]]));
        let (header, data) = file.split_at(10 + length);
        assert_eq!((&header[..8], header.len() % ALIGNMENT, header.last()), (MAGIC, 0, Some(&b'\n')));
        (std::str::from_utf8(&header[10..]).expect("text"), data)
    }

    #[test]
    fn file_has_row_count_and_numbers() {
        let row = [1.0, 2.0, 3.0, 4.0, 5.0, -6.0];
        let file = written(&[2, 3], &[&row, &row]);
        let (text, data) = parsed(&file);
        assert_eq!((file.len(), data), (128 + 48, bytemuck::cast_slice(&[row, row].concat())));
        assert!(text.contains("'shape': (2, 2, 3,)") && text.contains("'<f4'"), "{text}");
    }

    #[test]
    fn long_header_does_not_overwrite_the_data() {
        let shape = [vec![1; 30], vec![2]].concat();
        let file = written(&shape, &[&[1.5, -2.5]]);
        let (text, data) = parsed(&file);
        assert!(text.trim_end().len() > 117, "the header is short: {text}");
        assert_eq!(data, bytemuck::cast_slice(&[1.5_f32, -2.5]));
        assert!(text.starts_with(&dictionary(1, &shape)), "{text}");
        for rows in [0, 9, 10, u64::MAX] {
            assert!(10 + dictionary(rows, &shape).len() < header_bytes(&shape));
        }
    }

    #[test]
    fn row_of_another_length_and_too_many_axes_are_refused() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("rows.npy");
        assert!(Writer::create(&path, &[2, 3]).expect("creates").row(&[0.0; 5]).is_err());
        let refusal = Writer::create(&path, &[1; 30_000]).err().expect("refused").to_string();
        assert!(refusal.contains("30000 axes"), "{refusal}");
    }
}
