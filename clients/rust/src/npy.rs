//! Writes NumPy files of f32 rows incrementally. The header has space for the digits of any number of rows.
//! [`Writer::finish`] rewrites the header with the final number.

use std::fs::File;
use std::io::{BufWriter, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// The start of a file of format version 1.0. The length of the rest of the header follows as u16.
const MAGIC: &[u8] = b"\x93NUMPY\x01\x00";

/// Size of the magic string and of the length of the rest of the header.
const PREFIX_BYTES: usize = MAGIC.len() + size_of::<u16>();

/// The format pads the header with spaces and a newline, so that the data starts at a multiple of 64 bytes.
const ALIGNMENT: usize = 64;

/// The dictionary up to the number of rows.
const DICTIONARY_START: &str = "{'descr': '<f4', 'fortran_order': False, 'shape': (";

/// Writer of a `.npy` file of shape rows x `shape`, little-endian f32, C order.
pub struct Writer {
    path: PathBuf,
    file: BufWriter<File>,
    /// Shape of one row.
    shape: Vec<usize>,
    /// Size of the whole header, magic string included.
    header_bytes: usize,
    row_count: u64,
}

impl Writer {
    /// Creates the file; `shape` is the shape of one row.
    ///
    /// # Errors
    /// `File` if it cannot be written, or if the shape has so many axes that it exceeds the header of version 1.0.
    pub fn create(path: &Path, shape: &[usize]) -> Result<Self> {
        let header_bytes = compute_header_bytes(shape);
        if header_bytes - PREFIX_BYTES > usize::from(u16::MAX) {
            let reason = format!("expected a shape that fits a NumPy 1.0 header, got {} axes", shape.len());
            return Err(Error::file(path, reason));
        }
        let file = File::create(path).map_err(|error| Error::file(path, error))?;
        let (path, file) = (path.to_owned(), BufWriter::new(file));
        let mut writer = Self { path, file, shape: shape.to_vec(), header_bytes, row_count: 0 };
        writer.write_header()?;
        Ok(writer)
    }

    /// Continues an existing file of this shape after its first `row_count` rows, and removes later rows. The number of
    /// rows in the header is not read: a process that ended without [`Self::finish`] has not updated it.
    ///
    /// # Errors
    /// `File` if it cannot be changed, has another shape or type, or fewer rows.
    pub fn resume(path: &Path, shape: &[usize], row_count: u64) -> Result<Self> {
        let file_error = |error: std::io::Error| Error::file(path, error);
        let header_bytes = compute_header_bytes(shape);
        let mut file = File::options().read(true).write(true).open(path).map_err(file_error)?;
        let mut header = vec![0; header_bytes];
        let file_bytes = file.metadata().map_err(file_error)?.len();
        let is_complete = file.read_exact(&mut header).is_ok();
        if !is_complete || !has_shape(&header, shape) {
            return Err(Error::file(
                path,
                format!("expected NumPy rows of f32 and of the shape {shape:?}, got another file"),
            ));
        }
        let row_bytes = (size_of::<f32>() * shape.iter().product::<usize>()) as u64;
        let end = row_bytes.saturating_mul(row_count).saturating_add(header_bytes as u64);
        if file_bytes < end {
            let given = (file_bytes - header_bytes as u64) / row_bytes.max(1);
            return Err(Error::file(path, format!("expected at least {row_count} rows, got {given}")));
        }
        file.set_len(end).map_err(file_error)?;
        file.seek(SeekFrom::End(0)).map_err(file_error)?;
        Ok(Self { path: path.to_owned(), file: BufWriter::new(file), shape: shape.to_vec(), header_bytes, row_count })
    }

    /// The number of rows.
    pub const fn row_count(&self) -> u64 {
        self.row_count
    }

    /// Writes one row.
    ///
    /// # Errors
    /// `File` if its length does not match the shape, or if it cannot be written.
    pub fn write_row(&mut self, numbers: &[f32]) -> Result<()> {
        let expected: usize = self.shape.iter().product();
        if numbers.len() != expected {
            let reason = format!("expected rows of {expected} numbers, got {}", numbers.len());
            return Err(Error::file(&self.path, reason));
        }
        self.row_count += 1;
        self.write_bytes(bytemuck::cast_slice(numbers))
    }

    /// Writes the number of rows into the header, and makes all rows so far durable.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn sync(&mut self) -> Result<()> {
        self.update_header()?;
        self.file.seek(SeekFrom::End(0)).map_err(|error| Error::file(&self.path, error))?;
        self.file.get_ref().sync_data().map_err(|error| Error::file(&self.path, error))
    }

    /// Writes the number of rows into the header, closes the file and returns the number.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn finish(mut self) -> Result<u64> {
        self.update_header()?;
        self.file.flush().map_err(|error| Error::file(&self.path, error))?;
        Ok(self.row_count)
    }

    fn update_header(&mut self) -> Result<()> {
        self.file.seek(SeekFrom::Start(0)).map_err(|error| Error::file(&self.path, error))?;
        self.write_header()
    }

    /// Writes the magic string, length, dictionary, padding and newline: `header_bytes` bytes for every number of rows.
    fn write_header(&mut self) -> Result<()> {
        let length = self.header_bytes - PREFIX_BYTES;
        let mut header = MAGIC.to_vec();
        header.extend((length as u16).to_le_bytes());
        header.extend(format_dictionary(self.row_count, &self.shape).into_bytes());
        header.resize(self.header_bytes - 1, b' ');
        header.push(b'\n');
        self.write_bytes(&header)
    }

    fn write_bytes(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(|error| Error::file(&self.path, error))
    }
}

/// Size of the header with the largest number of rows; at least 128 bytes, the usual size of NumPy's own headers.
fn compute_header_bytes(shape: &[usize]) -> usize {
    let bytes = PREFIX_BYTES + format_dictionary(u64::MAX, shape).len() + 1;
    bytes.next_multiple_of(ALIGNMENT).max(2 * ALIGNMENT)
}

/// The Python dictionary in the header.
fn format_dictionary(row_count: u64, shape: &[usize]) -> String {
    format!("{DICTIONARY_START}{row_count}{}", format_dictionary_end(shape))
}

/// The dictionary after the number of rows.
fn format_dictionary_end(shape: &[usize]) -> String {
    let shape: String = shape.iter().map(|size| format!(" {size},")).collect();
    format!(",{shape}), }}")
}

/// Whether a header of this module has rows of this shape. The number of rows may be any.
fn has_shape(header: &[u8], shape: &[usize]) -> bool {
    let Some((prefix, dictionary)) = header.split_at_checked(PREFIX_BYTES) else { return false };
    let length = (header.len() - PREFIX_BYTES) as u16;
    let text = std::str::from_utf8(dictionary).unwrap_or_default().trim_end();
    let row_count =
        text.strip_prefix(DICTIONARY_START).and_then(|rest| rest.strip_suffix(&format_dictionary_end(shape)));
    prefix == [MAGIC, &length.to_le_bytes()].concat() && row_count.is_some_and(|text| text.parse::<u64>().is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a file and returns its bytes.
    fn write_file(shape: &[usize], rows: &[&[f32]]) -> Vec<u8> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("rows.npy");
        let mut writer = Writer::create(&path, shape).expect("a new file");
        rows.iter().for_each(|row| writer.write_row(row).expect("a row of the right length"));
        assert_eq!(writer.finish().expect("a complete file"), rows.len() as u64);
        std::fs::read(&path).expect("a readable file")
    }

    /// Splits a file into the text of its header and its data by the length that the header states.
    fn split_file(file: &[u8]) -> (&str, &[u8]) {
        let length = usize::from(u16::from_le_bytes([file[8], file[9]]));
        let (header, data) = file.split_at(PREFIX_BYTES + length);
        assert_eq!((&header[..8], header.len() % ALIGNMENT, header.last()), (MAGIC, 0, Some(&b'\n')));
        (std::str::from_utf8(&header[PREFIX_BYTES..]).expect("text"), data)
    }

    #[test]
    fn file_has_row_count_and_numbers() {
        let row = [1.0, 2.0, 3.0, 4.0, 5.0, -6.0];
        let file = write_file(&[2, 3], &[&row, &row]);
        let (text, data) = split_file(&file);
        // A header of 128 bytes, and two rows of six f32.
        assert_eq!((file.len(), data), (128 + 48, bytemuck::cast_slice(&[row, row].concat())));
        assert!(text.contains("'shape': (2, 2, 3,)") && text.contains("'<f4'"), "{text}");
    }

    #[test]
    fn long_header_does_not_overwrite_the_data() {
        let shape = [vec![1; 30], vec![2]].concat();
        let file = write_file(&shape, &[&[1.5, -2.5]]);
        let (text, data) = split_file(&file);
        // A header of 128 bytes has space for a text of 128 - 10 - 1 = 117 characters.
        assert!(text.trim_end().len() > 117, "expected a header of more than 128 bytes, got: {text}");
        assert_eq!(data, bytemuck::cast_slice(&[1.5_f32, -2.5]));
        assert!(text.starts_with(&format_dictionary(1, &shape)), "{text}");
        for row_count in [0, 9, 10, u64::MAX] {
            assert!(PREFIX_BYTES + format_dictionary(row_count, &shape).len() < compute_header_bytes(&shape));
        }
    }

    #[test]
    fn row_of_another_length_and_too_many_axes_are_rejected() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("rows.npy");
        assert!(Writer::create(&path, &[2, 3]).expect("a new file").write_row(&[0.0; 5]).is_err());
        let error = Writer::create(&path, &[1; 30_000]).err().expect("an error").to_string();
        assert!(error.contains("30000 axes"), "{error}");
    }

    /// A process was killed: the header has no rows yet, and the last row is incomplete.
    #[test]
    fn file_continues_after_a_number_of_rows() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("rows.npy");
        let row = |number: usize| [number as f32, -1.0];
        let mut writer = Writer::create(&path, &[2]).expect("a new file");
        (0..3).for_each(|number| writer.write_row(&row(number)).expect("a row"));
        writer.sync().expect("a durable file");
        let text_of = |file: &[u8]| split_file(file).0.to_owned();
        assert!(text_of(&std::fs::read(&path).expect("a file")).contains("'shape': (3, 2,)"));
        writer.write_row(&row(3)).expect("a row");
        drop(writer);
        let complete = std::fs::read(&path).expect("a file");
        std::fs::write(&path, &complete[..complete.len() - 3]).expect("a writable file");
        let mut writer = Writer::resume(&path, &[2], 2).expect("a file of these rows");
        (2..5).for_each(|number| writer.write_row(&row(number)).expect("a row"));
        assert_eq!((writer.row_count(), writer.finish().expect("a complete file")), (5, 5));
        let rows: Vec<[f32; 2]> = (0..5).map(row).collect();
        assert_eq!(
            std::fs::read(&path).expect("a file"),
            write_file(&[2], &rows.iter().map(|row| &row[..]).collect::<Vec<_>>())
        );
    }

    #[test]
    fn file_of_another_shape_type_or_length_is_not_continued() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("rows.npy");
        let file = write_file(&[2], &[&[1.0, 2.0]]);
        let resume = |bytes: &[u8], shape: &[usize], row_count: u64| {
            std::fs::write(&path, bytes).expect("a writable file");
            let error = Writer::resume(&path, shape, row_count).err().map(|error| error.to_string());
            assert_eq!(std::fs::read(&path).expect("a file").len(), bytes.len(), "expected an unchanged file");
            error.unwrap_or_default()
        };
        assert_eq!(resume(&file, &[2], 1), "", "control");
        assert!(resume(&file, &[2], 2).contains("at least 2 rows, got 1"));
        assert!(resume(&file, &[2], u64::MAX).contains("got 1"));
        let mut other_type = file.clone();
        let digit = file.windows(3).position(|bytes| bytes == b"<f4").expect("a type") + 2;
        other_type[digit] = b'8';
        let cases: [(&[u8], &[usize]); 5] =
            [(&file, &[3]), (&file, &[2, 1]), (&file, &[]), (&file[..100], &[2]), (&[], &[2])];
        for (bytes, shape) in cases.into_iter().chain([(&other_type[..], &[2_usize][..])]) {
            assert!(resume(bytes, shape, 0).contains("got another file"), "{shape:?}");
        }
    }
}
