//! Writes NumPy files of f32 rows incrementally. The header is padded and is rewritten when the number of rows is
//! known.

use std::fs::File;
use std::io::{BufWriter, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result, malformed_reply};

/// Bytes of the header with its padding: enough for the shapes in use, and a multiple of 64 for alignment.
const HEADER: usize = 128;

/// Writer of a `.npy` file of shape rows x `shape`, little-endian f32, C order.
pub struct Writer {
    path: PathBuf,
    file: BufWriter<File>,
    shape: Vec<usize>,
    rows: u64,
}

impl Writer {
    /// Creates the file; `shape` is the shape of one row.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn create(path: &Path, shape: &[usize]) -> Result<Self> {
        let file = File::create(path).map_err(|fault| Error::file(path, fault))?;
        let mut writer = Self { path: path.to_owned(), file: BufWriter::new(file), shape: shape.to_vec(), rows: 0 };
        writer.put(&header(0, shape))?;
        Ok(writer)
    }

    /// Adds one row.
    ///
    /// # Errors
    /// `Malformed` if its length does not match the shape; `File` if it cannot be written.
    pub fn row(&mut self, numbers: &[f32]) -> Result<()> {
        let expected: usize = self.shape.iter().product();
        if numbers.len() != expected {
            return Err(malformed_reply("npy.row", expected, numbers.len()));
        }
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.rows += 1;
        self.put(&bytes)
    }

    /// Writes the number of rows into the header and closes the file.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn finish(mut self) -> Result<u64> {
        let head = header(self.rows, &self.shape);
        self.file.seek(SeekFrom::Start(0)).map_err(|fault| Error::file(&self.path, fault))?;
        self.put(&head)?;
        self.file.flush().map_err(|fault| Error::file(&self.path, fault))?;
        Ok(self.rows)
    }

    fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(|fault| Error::file(&self.path, fault))
    }
}

/// The header of version 1.0: magic, version, length, dictionary, padding, newline.
fn header(rows: u64, shape: &[usize]) -> Vec<u8> {
    let shape: String = shape.iter().map(|size| format!(" {size},")).collect();
    let mut text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows},{shape}), }}");
    let room = HEADER - 10;
    text.extend(std::iter::repeat_n(' ', room.saturating_sub(text.len() + 1)));
    text.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.into_bytes());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_has_row_count_and_numbers() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("rows.npy");
        let mut writer = Writer::create(&path, &[2, 3]).expect("creates");
        let row = [1.0, 2.0, 3.0, 4.0, 5.0, -6.0];
        writer.row(&row).expect("fits");
        writer.row(&row).expect("fits");
        assert!(writer.row(&row[..5]).is_err());
        assert_eq!(writer.finish().expect("closes"), 2);
        let bytes = std::fs::read(&path).expect("reads");
        assert_eq!((bytes.len(), &bytes[..8], bytes[HEADER - 1]), (HEADER + 48, &b"\x93NUMPY\x01\x00"[..], b'\n'));
        assert_eq!(u16::from_le_bytes([bytes[8], bytes[9]]) as usize, HEADER - 10);
        let text = String::from_utf8_lossy(&bytes[10..HEADER]);
        assert!(text.contains("'shape': (2, 2, 3,)") && text.contains("'<f4'"), "{text}");
        assert_eq!(bytes[HEADER + 44..], (-6.0_f32).to_le_bytes());
    }
}
