//! Reader of the elements after the header of a PLY file.

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyType};

use super::element::{PlyElement, full_channel};
use crate::error::{Error, Result, invalid};
use crate::escaping::escape_controls;

/// The longest part of a word or of a parser error in an error message, in characters.
pub(super) const MAX_REASON_CHARACTERS: usize = 160;

/// Reads the elements of one definition, one after another, so that memory does not depend on their number.
pub(super) struct ElementReader<'a> {
    /// The rest of the file.
    pub(super) body: &'a [u8],
    pub(super) encoding: Encoding,
    pub(super) definition: &'a ElementDef,
}

impl ElementReader<'_> {
    /// # Errors
    /// `Invalid` with the element for content that the header does not declare, and those of `add`.
    pub(super) fn for_each<E: PlyElement>(&mut self, mut add: impl FnMut(usize, E) -> Result<()>) -> Result<()> {
        let parser = Parser::<E>::new();
        for index in 0..self.definition.count {
            let element = match self.encoding {
                Encoding::Ascii => self.read_text(),
                Encoding::BinaryLittleEndian => {
                    parser.read_little_endian_element(&mut self.body, self.definition).map_err(incomplete)
                }
                Encoding::BinaryBigEndian => {
                    parser.read_big_endian_element(&mut self.body, self.definition).map_err(incomplete)
                }
            };
            let in_element = |error: Error| match error {
                Error::Invalid { field, expected, given } if field.is_empty() => {
                    invalid(format!("{} {index}", self.definition.name), expected, given)
                }
                error => error.prefix_field(&format!("{} {index}", self.definition.name)),
            };
            add(index, element.map_err(in_element)?)?;
        }
        Ok(())
    }

    /// Reads an element of a text, which may have any line ends and take several lines.
    fn read_text<E: PlyElement>(&mut self) -> Result<E> {
        let mut element = E::new();
        for (name, property) in &self.definition.properties {
            let in_property = |error: Error| error.prefix_field(&format!("property {name}"));
            match &property.data_type {
                PropertyType::Scalar(scalar) => {
                    let value = self.read_number().map_err(in_property)?;
                    element.set_scalar(name, value, full_channel(scalar));
                }
                PropertyType::List(..) => {
                    let count = self.read_number().map_err(in_property)?;
                    if count.fract() != 0.0 || !(0.0..=self.body.len() as f64).contains(&count) {
                        let expected = format!("a length of at most {} bytes that follow", self.body.len());
                        return Err(in_property(invalid("list", expected, count)));
                    }
                    let values: Result<Vec<f64>> = (0..count as usize).map(|_| self.read_number()).collect();
                    element.set_list(name, values.map_err(in_property)?);
                }
            }
        }
        let line = self.body.split(|byte| matches!(byte, b'\n' | b'\r')).next().unwrap_or_default();
        match line.trim_ascii().is_empty() {
            true => Ok(element),
            false => Err(invalid("", "a line end after the declared properties", quote(line))),
        }
    }

    fn read_number(&mut self) -> Result<f64> {
        let body = self.body.trim_ascii_start();
        let length = body.iter().position(u8::is_ascii_whitespace).unwrap_or(body.len());
        let (word, rest) = body.split_at(length);
        self.body = rest;
        if word.is_empty() {
            return Err(invalid("number", "a number", "the end of the file"));
        }
        let number = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
        number.ok_or_else(|| invalid("number", "a number", quote(word)))
    }
}

fn incomplete(error: impl std::fmt::Display) -> Error {
    invalid("", "a complete element", quote(error.to_string().as_bytes()))
}

/// Text of a file or a parser for an error message.
pub(super) fn quote(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text.trim_ascii());
    escape_controls(&text).chars().take(MAX_REASON_CHARACTERS).collect()
}
