//! A position in the bytes of a mesh file, whose numbers are text or binary.

use std::str::FromStr;

use modalcast_model::error::{Result, invalid};

/// How the numbers of a file are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Separated by white space.
    Text,
    LittleEndian,
    BigEndian,
}

/// The type of the numbers of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberType {
    Signed { bytes: usize },
    Unsigned { bytes: usize },
    Float { bytes: usize },
}

/// The numbers of an array.
#[derive(Debug, Clone, PartialEq)]
pub enum Numbers {
    Integers(Vec<i64>),
    Floats(Vec<f64>),
}

impl NumberType {
    /// The size of a number.
    pub const fn bytes(self) -> usize {
        match self {
            Self::Signed { bytes } | Self::Unsigned { bytes } | Self::Float { bytes } => bytes,
        }
    }

    /// The numbers in binary data. Bytes after the last whole number are ignored.
    pub fn decode(self, data: &[u8], encoding: Encoding) -> Numbers {
        let little_endian = |number: &[u8]| {
            let mut wide = [0; 8];
            wide[..number.len()].copy_from_slice(number);
            if encoding == Encoding::BigEndian {
                wide[..number.len()].reverse();
            }
            u64::from_le_bytes(wide)
        };
        let numbers = data.chunks_exact(self.bytes()).map(little_endian);
        match self {
            Self::Signed { bytes } => {
                let unused_bits = 64 - 8 * bytes as u32;
                Numbers::Integers(numbers.map(|number| (number as i64) << unused_bits >> unused_bits).collect())
            }
            // Indices beyond the range of i64 are wrong and become negative.
            Self::Unsigned { .. } => Numbers::Integers(numbers.map(|number| number as i64).collect()),
            Self::Float { bytes: 4 } => {
                Numbers::Floats(numbers.map(|number| f64::from(f32::from_bits(number as u32))).collect())
            }
            Self::Float { .. } => Numbers::Floats(numbers.map(f64::from_bits).collect()),
        }
    }

    /// The numbers in a text.
    ///
    /// # Errors
    /// `Invalid` with the first word that is no number.
    pub fn parse<'a>(self, mut words: impl Iterator<Item = &'a str>) -> Result<Numbers> {
        fn number<T: FromStr>(word: &str) -> Result<T> {
            word.parse().map_err(|_| invalid("number", "a number", format!("'{word}'")))
        }
        match self {
            Self::Float { .. } => words
                .try_fold(Vec::new(), |mut numbers, word| {
                    numbers.push(number(word)?);
                    Ok(numbers)
                })
                .map(Numbers::Floats),
            _ => words
                .try_fold(Vec::new(), |mut numbers, word| {
                    numbers.push(number(word)?);
                    Ok(numbers)
                })
                .map(Numbers::Integers),
        }
    }
}

impl Numbers {
    /// All numbers as floats.
    pub fn into_floats(self) -> Vec<f64> {
        match self {
            Self::Integers(numbers) => numbers.into_iter().map(|number| number as f64).collect(),
            Self::Floats(numbers) => numbers,
        }
    }

    /// The numbers of an array of integers.
    ///
    /// # Errors
    /// `Invalid` for floats.
    pub fn into_integers(self, field: &str) -> Result<Vec<i64>> {
        match self {
            Self::Integers(numbers) => Ok(numbers),
            Self::Floats(_) => Err(invalid(field, "integers", "floating-point numbers")),
        }
    }
}

/// A position in a file.
#[derive(Debug, Clone)]
pub struct FileCursor<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> FileCursor<'a> {
    /// The start of a file.
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, position: 0 }
    }

    /// The bytes from here on.
    pub fn rest(&self) -> &'a [u8] {
        &self.bytes[self.position..]
    }

    /// The next line without its end; `None` at the end of the file.
    pub fn line(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest();
        if rest.is_empty() {
            return None;
        }
        let length = rest.iter().position(|byte| *byte == b'\n').unwrap_or(rest.len());
        self.position += (length + 1).min(rest.len());
        Some(rest[..length].trim_ascii_end())
    }

    /// The next line that is not empty, as text; `None` at the end of the file.
    pub fn text_line(&mut self) -> Option<String> {
        loop {
            let line = self.line()?.trim_ascii();
            if !line.is_empty() {
                return Some(String::from_utf8_lossy(line).into_owned());
            }
        }
    }

    /// The next word; `None` at the end of the file.
    pub fn word(&mut self) -> Option<&'a str> {
        let rest = self.rest();
        let start = rest.iter().position(|byte| !byte.is_ascii_whitespace())?;
        let length = rest[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len() - start);
        self.position += start + length;
        // Bytes that are no text give an empty word, which is no number.
        Some(std::str::from_utf8(&rest[start..start + length]).unwrap_or_default())
    }

    /// The next `count` bytes.
    ///
    /// # Errors
    /// `Invalid` at the end of the file.
    pub fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        let taken = self.rest().get(..count).ok_or_else(|| {
            invalid("binary data", format!("{count} bytes"), format!("{} at the end of the file", self.rest().len()))
        })?;
        self.position += count;
        Ok(taken)
    }

    /// The next number of the given type.
    ///
    /// # Errors
    /// `Invalid` for a word that is no number, and at the end of the file.
    pub fn number<T: FromStr + FileNumber>(&mut self, encoding: Encoding) -> Result<T> {
        if encoding != Encoding::Text {
            let bytes = self.take(size_of::<T>())?;
            return Ok(T::from_bytes(bytes, encoding == Encoding::BigEndian));
        }
        let word = self.word().ok_or_else(|| invalid("text", "a number", "the end of the file"))?;
        word.parse().map_err(|_| invalid("text", "a number", format!("'{word}'")))
    }

    /// Skips to the end of the line that contains `text`.
    ///
    /// # Errors
    /// `Invalid` if no line does.
    pub fn skip_past(&mut self, text: &str) -> Result<()> {
        let found = self.rest().windows(text.len()).position(|window| window == text.as_bytes());
        let offset = found.ok_or_else(|| invalid("text", text, "the end of the file"))?;
        self.position += offset;
        self.line();
        Ok(())
    }
}

/// Numbers that are stored in binary files.
pub trait FileNumber: Sized {
    /// Decodes a number from as many bytes as the type has.
    fn from_bytes(bytes: &[u8], is_big_endian: bool) -> Self;
}

macro_rules! file_number {
    ($($number:ty),*) => {$(
        impl FileNumber for $number {
            fn from_bytes(bytes: &[u8], is_big_endian: bool) -> Self {
                let mut array = [0; size_of::<$number>()];
                array.copy_from_slice(bytes);
                if is_big_endian { Self::from_be_bytes(array) } else { Self::from_le_bytes(array) }
            }
        }
    )*};
}

file_number!(i32, u64, f64);

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Reads all beginnings of a file, and the file with random bytes.
    pub(crate) fn damage(bytes: &[u8], read: impl Fn(&[u8])) {
        (0..bytes.len()).for_each(|length| read(&bytes[..length]));
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..3000 {
            let mut damaged = bytes.to_vec();
            for _ in 0..random.usize(1..4) {
                let index = random.usize(..damaged.len());
                damaged[index] = random.u8(..);
            }
            read(&damaged);
        }
    }

    #[test]
    fn words_lines_and_binary_numbers_are_read_in_order() {
        let mut bytes = b"head 1 -2.5\r\n\n next\n".to_vec();
        bytes.extend(7_i32.to_be_bytes());
        bytes.extend(2.5_f64.to_be_bytes());
        bytes.extend(b"\nend here\nlast");
        let mut cursor = FileCursor::new(&bytes);
        assert_eq!(cursor.word(), Some("head"));
        assert_eq!(cursor.number::<i32>(Encoding::Text), Ok(1));
        assert_eq!(cursor.number::<f64>(Encoding::Text), Ok(-2.5));
        assert_eq!(cursor.line(), Some(&b""[..]));
        assert_eq!(cursor.text_line().as_deref(), Some("next"));
        assert_eq!(cursor.number::<i32>(Encoding::BigEndian), Ok(7));
        assert_eq!(cursor.number::<f64>(Encoding::BigEndian), Ok(2.5));
        assert!(cursor.skip_past("$End").is_err());
        cursor.skip_past("end").expect("a line");
        assert!(cursor.take(5).is_err() && cursor.clone().number::<i32>(Encoding::Text).is_err());
        assert_eq!(cursor.line(), Some(&b"last"[..]));
        assert_eq!((cursor.line(), cursor.word()), (None, None));
    }

    #[test]
    fn arrays_of_all_types_are_decoded() {
        let signed = NumberType::Signed { bytes: 2 };
        assert_eq!(signed.decode(&[0xff, 0xfe, 0, 3, 9], Encoding::BigEndian), Numbers::Integers(vec![-2, 3]));
        assert_eq!(signed.decode(&[0xfe, 0xff], Encoding::LittleEndian), Numbers::Integers(vec![-2]));
        let unsigned = NumberType::Unsigned { bytes: 1 };
        assert_eq!(unsigned.decode(&[200], Encoding::LittleEndian), Numbers::Integers(vec![200]));
        let float = NumberType::Float { bytes: 4 };
        assert_eq!(float.decode(&1.5_f32.to_be_bytes(), Encoding::BigEndian), Numbers::Floats(vec![1.5]));
        let wide = NumberType::Signed { bytes: 8 };
        assert_eq!(wide.decode(&(-5_i64).to_le_bytes(), Encoding::LittleEndian), Numbers::Integers(vec![-5]));
        assert_eq!(unsigned.parse("1 2".split(' ')), Ok(Numbers::Integers(vec![1, 2])));
        assert!(unsigned.parse("1 2.5".split(' ')).is_err() && float.parse("x".split(' ')).is_err());
    }
}
