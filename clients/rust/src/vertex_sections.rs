//! Writes the bytes of a step's sections into the arrays of a [`VertexSet`](crate::VertexSet) as they arrive. Numbers
//! that arrive as f32 are copied once, from the received frames into their array.

use std::sync::Arc;

use modalcast_proto::v1;
use v1::{Attribute, Encoding};

use crate::assemble::decode;
use crate::error::{Result, malformed_reply};
use crate::vertex_encoding::{check_section_bytes, decode_vectors};

/// A selected domain of a [`VertexSet`](crate::VertexSet).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VertexSetDomain {
    pub index: u32,
    pub vertex_count: u32,
    pub corner_count: u32,
}

/// The arrays of a step, in the order and with the lengths that [`VertexSet`](crate::VertexSet) states.
#[derive(Debug, Default)]
pub(crate) struct VertexArrays {
    pub(crate) positions: Vec<f32>,
    pub(crate) normals: Vec<f32>,
    pub(crate) displacements: Vec<f32>,
    pub(crate) boxes: Vec<[[f32; 3]; 2]>,
    /// `None` if the step has no origins.
    pub(crate) origins: Option<Arc<[[f64; 3]]>>,
}

/// The sections of a step, of which a part was received.
#[derive(Debug)]
pub(crate) struct SectionWriter {
    sections: Vec<OpenSection>,
    /// Index of the section that receives the next byte.
    next_section: usize,
    /// Number of selected domains.
    domain_count: usize,
}

#[derive(Debug)]
struct OpenSection {
    attribute: Attribute,
    encoding: Encoding,
    vector_count: usize,
    /// Number of bytes that were not received yet.
    missing_bytes: usize,
    content: SectionContent,
}

#[derive(Debug)]
enum SectionContent {
    /// Numbers that arrive as f32.
    Numbers(NumberArray),
    /// Bytes to decode when all have arrived.
    Encoded(Vec<u8>),
    /// An attribute of a newer server.
    Ignored,
}

impl SectionWriter {
    /// Checks the sections in `head`, and reserves memory for them.
    ///
    /// # Errors
    /// `Malformed` unless the sections follow each other, have the sizes of the selected domains, and end at the total
    /// of the head.
    pub(crate) fn new(head: &v1::VertexHead, domains: &[VertexSetDomain]) -> Result<Self> {
        let sum =
            |count: fn(&VertexSetDomain) -> u32| domains.iter().map(|domain| count(domain) as usize).sum::<usize>();
        let (vertex_count, corner_count) = (sum(|domain| domain.vertex_count), sum(|domain| domain.corner_count));
        let mut sections = Vec::with_capacity(head.sections.len());
        let mut offset = 0;
        for (index, section) in head.sections.iter().enumerate() {
            let field = format!("vertices.sections[{index}]");
            let end = section.offset.checked_add(section.bytes).filter(|end| *end <= head.total);
            let Some(end) = end.filter(|_| section.offset == offset) else {
                let expected = format!("a section at {offset} within {} bytes", head.total);
                return Err(malformed_reply(field, expected, format!("{} bytes at {}", section.bytes, section.offset)));
            };
            offset = end;
            let vector_count = match section.attribute() {
                Attribute::Positions | Attribute::Displacements => vertex_count,
                Attribute::Normals => corner_count,
                Attribute::Boxes => 2 * domains.len(),
                Attribute::Origins | Attribute::Unspecified => 0,
            };
            sections.push(OpenSection::new(&field, section, vector_count)?);
        }
        if offset != head.total {
            return Err(malformed_reply("vertices.total", offset, head.total));
        }
        Ok(Self { sections, next_section: 0, domain_count: domains.len() })
    }

    /// Adds the next bytes of the step.
    pub(crate) fn write(&mut self, mut bytes: &[u8]) {
        while let Some(section) = self.sections.get_mut(self.next_section).filter(|_| !bytes.is_empty()) {
            let (section_bytes, rest) = bytes.split_at(section.missing_bytes.min(bytes.len()));
            section.write(section_bytes);
            if section.missing_bytes == 0 {
                self.next_section += 1;
            }
            bytes = rest;
        }
    }

    /// Decodes the sections that have not arrived as f32. Requires that all bytes of the step were written.
    ///
    /// # Errors
    /// `Malformed` if a section has a wrong number of origins or cannot be decoded.
    pub(crate) fn finish(self) -> Result<VertexArrays> {
        let mut arrays = VertexArrays::default();
        for (index, section) in self.sections.into_iter().enumerate() {
            let field = format!("vertices.sections[{index}]");
            let attribute = section.attribute;
            let numbers = match section.content {
                SectionContent::Ignored => continue,
                SectionContent::Numbers(array) => array.numbers,
                SectionContent::Encoded(bytes) if attribute == Attribute::Origins => {
                    arrays.origins = Some(decode_origins(&field, &bytes, self.domain_count)?);
                    continue;
                }
                SectionContent::Encoded(bytes) if attribute == Attribute::Boxes => {
                    arrays.boxes = decode(&field, &bytes)?;
                    continue;
                }
                SectionContent::Encoded(bytes) => {
                    decode_vectors(&field, section.encoding, section.vector_count, &bytes)?
                }
            };
            match attribute {
                Attribute::Positions => arrays.positions = numbers,
                Attribute::Normals => arrays.normals = numbers,
                Attribute::Displacements => arrays.displacements = numbers,
                Attribute::Boxes | Attribute::Origins | Attribute::Unspecified => {}
            }
        }
        Ok(arrays)
    }
}

fn decode_origins(field: &str, bytes: &[u8], domain_count: usize) -> Result<Arc<[[f64; 3]]>> {
    let origins: Vec<[f64; 3]> = decode(field, bytes)?;
    if origins.len() != 1 && origins.len() != domain_count {
        return Err(malformed_reply(field, format!("1 or {domain_count} origins"), origins.len()));
    }
    Ok(origins.into())
}

impl OpenSection {
    fn new(field: &str, section: &v1::VertexSection, vector_count: usize) -> Result<Self> {
        let (attribute, encoding) = (section.attribute(), section.encoding());
        if !matches!(attribute, Attribute::Origins | Attribute::Unspecified) {
            check_section_bytes(field, encoding, vector_count, section.bytes)?;
        }
        // A size that this machine cannot hold is an error, not an abort.
        let too_large = || malformed_reply(format!("{field}.bytes"), "a size that fits in memory", section.bytes);
        let missing_bytes = usize::try_from(section.bytes).map_err(|_| too_large())?;
        let is_f32 = matches!(encoding, Encoding::F32 | Encoding::Unspecified);
        let content = match attribute {
            Attribute::Unspecified => SectionContent::Ignored,
            Attribute::Positions | Attribute::Normals | Attribute::Displacements if is_f32 => {
                let mut numbers = Vec::new();
                numbers.try_reserve_exact(missing_bytes / size_of::<f32>()).map_err(|_| too_large())?;
                SectionContent::Numbers(NumberArray { numbers, ..NumberArray::default() })
            }
            _ => {
                let mut bytes = Vec::new();
                bytes.try_reserve_exact(missing_bytes).map_err(|_| too_large())?;
                SectionContent::Encoded(bytes)
            }
        };
        Ok(Self { attribute, encoding, vector_count, missing_bytes, content })
    }

    /// Adds the next bytes, at most as many as are missing.
    fn write(&mut self, bytes: &[u8]) {
        self.missing_bytes -= bytes.len();
        match &mut self.content {
            SectionContent::Numbers(array) => array.write(bytes),
            SectionContent::Encoded(encoded) => encoded.extend_from_slice(bytes),
            SectionContent::Ignored => {}
        }
    }
}

/// An array of f32 from little-endian bytes that are split anywhere.
#[derive(Debug, Default)]
struct NumberArray {
    numbers: Vec<f32>,
    /// The first bytes of the next number.
    partial: [u8; 4],
    partial_bytes: usize,
}

impl NumberArray {
    fn write(&mut self, mut bytes: &[u8]) {
        if self.partial_bytes > 0 {
            let (completing, rest) = bytes.split_at((4 - self.partial_bytes).min(bytes.len()));
            self.partial[self.partial_bytes..][..completing.len()].copy_from_slice(completing);
            self.partial_bytes += completing.len();
            if self.partial_bytes < 4 {
                return;
            }
            self.numbers.push(f32::from_le_bytes(self.partial));
            bytes = rest;
        }
        let (numbers, rest) = bytes.as_chunks::<4>();
        self.numbers.extend(numbers.iter().map(|number| f32::from_le_bytes(*number)));
        self.partial[..rest.len()].copy_from_slice(rest);
        self.partial_bytes = rest.len();
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The first domain has one vertex and no corner. The second has no vertex and one corner.
    pub(crate) fn two_domains() -> Arc<[VertexSetDomain]> {
        let domain = |index, vertex_count, corner_count| VertexSetDomain { index, vertex_count, corner_count };
        [domain(4, 1, 0), domain(7, 0, 1)].into()
    }

    /// A head whose sections follow each other.
    pub(crate) fn head(sections: &[(Attribute, Encoding, u64)]) -> v1::VertexHead {
        let mut offset = 0;
        let wire_section = |(attribute, encoding, bytes): &(Attribute, Encoding, u64)| {
            let section = v1::VertexSection {
                attribute: (*attribute).into(),
                encoding: (*encoding).into(),
                offset,
                bytes: *bytes,
            };
            offset += bytes;
            section
        };
        let sections = sections.iter().map(wire_section).collect();
        v1::VertexHead { step: Some(v1::StepId::default()), sections, total: offset, ..Default::default() }
    }

    pub(crate) fn float_bytes(first: u16, count: u16) -> Vec<u8> {
        (first..first + count).flat_map(|x| f32::from(x).to_le_bytes()).collect()
    }

    pub(crate) const POSITIONS: (Attribute, Encoding, u64) = (Attribute::Positions, Encoding::F32, 12);
    pub(crate) const NORMALS: (Attribute, Encoding, u64) = (Attribute::Normals, Encoding::F32, 12);
    pub(crate) const ORIGIN: (Attribute, Encoding, u64) = (Attribute::Origins, Encoding::F64, 24);

    fn write_all(head: &v1::VertexHead, bytes: &[u8], piece_bytes: usize) -> Result<VertexArrays> {
        let mut writer = SectionWriter::new(head, &two_domains())?;
        bytes.chunks(piece_bytes).for_each(|piece| writer.write(piece));
        writer.finish()
    }

    #[test]
    fn arrays_do_not_depend_on_how_the_bytes_are_split() {
        let ignored = (Attribute::Unspecified, Encoding::F32, 7);
        let head = head(&[POSITIONS, ignored, NORMALS, (Attribute::Displacements, Encoding::F16, 6), ORIGIN]);
        let half_bytes = vec![0, 0x3c, 0, 0xc0, 0, 0];
        let bytes = [float_bytes(1, 3), vec![9; 7], float_bytes(5, 3), half_bytes, vec![0; 24]].concat();
        for piece_bytes in 1..=bytes.len() {
            let arrays = write_all(&head, &bytes, piece_bytes).expect("valid sections");
            assert_eq!(arrays.positions, [1.0, 2.0, 3.0], "pieces of {piece_bytes} bytes");
            assert_eq!(arrays.normals, [5.0, 6.0, 7.0], "pieces of {piece_bytes} bytes");
            assert_eq!(arrays.displacements, [1.0, -2.0, 0.0], "pieces of {piece_bytes} bytes");
            assert_eq!(arrays.origins.as_deref(), Some(&[[0.0; 3]][..]), "pieces of {piece_bytes} bytes");
        }
    }

    #[test]
    fn malformed_sections_report_their_field() {
        let overlapping = v1::VertexHead {
            sections: vec![v1::VertexSection { attribute: 1, encoding: 1, offset: 4, bytes: 12 }],
            total: 16,
            ..head(&[])
        };
        let overflowing = v1::VertexHead {
            sections: vec![v1::VertexSection { attribute: 1, encoding: 1, offset: 0, bytes: u64::MAX }],
            total: 16,
            ..head(&[])
        };
        let with_total = |total, sections: &[_]| v1::VertexHead { total, ..head(sections) };
        for (head, field) in [
            (head(&[(Attribute::Positions, Encoding::F32, 24), ORIGIN]), "sections[0].bytes"),
            (head(&[POSITIONS, (Attribute::Boxes, Encoding::F32, 24)]), "sections[1].bytes"),
            (head(&[POSITIONS, (Attribute::Origins, Encoding::F64, 72)]), "sections[1]"),
            (head(&[(Attribute::Normals, Encoding::F64, 24)]), "sections[0]"),
            (with_total(24, &[POSITIONS, ORIGIN]), "sections[1]"),
            (with_total(40, &[POSITIONS, ORIGIN]), "total"),
            (overlapping, "sections[0]"),
            (overflowing, "sections[0]"),
        ] {
            let bytes = vec![0; head.total as usize];
            let error = write_all(&head, &bytes, 5).expect_err(field).to_string();
            assert!(error.contains(field), "expected {field}, got {error}");
        }
    }
}
