//! Writes bits in the order of deflate: the first bit is the lowest of the first byte.

/// Bytes that a buffer needs beyond its content, because the writer stores whole words.
pub(super) const SLACK_BYTES: usize = 8;

/// Writes bits to a buffer. Bits that do not fit are dropped, so the buffer must have the exact size of the content
/// plus [`SLACK_BYTES`].
pub(super) struct BitWriter<'a> {
    bytes: &'a mut [u8],
    /// Number of bytes that are complete.
    position: usize,
    /// Bits that are not stored yet, the first one lowest.
    bits: u64,
    bit_count: u32,
}

/// A word of at most 56 bits, the first bit lowest.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Bits {
    pub(super) value: u64,
    pub(super) count: u32,
}

impl Bits {
    /// These bits, then `next`.
    #[inline(always)]
    pub(super) const fn then(self, next: Self) -> Self {
        Self { value: self.value | next.value.wrapping_shl(self.count), count: self.count.wrapping_add(next.count) }
    }
}

impl<'a> BitWriter<'a> {
    pub(super) const fn new(bytes: &'a mut [u8]) -> Self {
        Self { bytes, position: 0, bits: 0, bit_count: 0 }
    }

    /// Appends bits.
    #[inline(always)]
    pub(super) fn write(&mut self, bits: Bits) {
        // At most 7 bits remain after a store, so 56 further bits fit.
        self.bits |= bits.value.wrapping_shl(self.bit_count);
        self.bit_count = self.bit_count.wrapping_add(bits.count);
        if let Some(target) = self.bytes.get_mut(self.position..).and_then(<[u8]>::first_chunk_mut) {
            *target = self.bits.to_le_bytes();
        }
        self.position = self.position.wrapping_add((self.bit_count / 8) as usize);
        self.bits = self.bits.wrapping_shr(self.bit_count & !7);
        self.bit_count &= 7;
    }

    /// Fills the last byte with zeros. Returns the number of bytes written.
    pub(super) fn align_to_byte(&mut self) -> usize {
        if self.bit_count > 0 {
            self.write(Bits { value: 0, count: 8 - self.bit_count });
        }
        self.position
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_fill_bytes_from_the_lowest() {
        let mut bytes = [0; 9 + SLACK_BYTES];
        let mut writer = BitWriter::new(&mut bytes);
        writer.write(Bits { value: 0b1, count: 1 }.then(Bits { value: 0b10, count: 2 }));
        writer.write(Bits { value: 0x0123_4567_89ab_cdef >> 8, count: 56 });
        assert_eq!(writer.align_to_byte(), 8);
        assert_eq!(writer.align_to_byte(), 8, "expected no change of an aligned writer");
        let number = u64::from_le_bytes(*bytes.first_chunk().expect("expected eight bytes"));
        assert_eq!(number, 0b101 | (0x0123_4567_89ab_cdef >> 8) << 3);
    }
}
