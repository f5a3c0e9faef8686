//! Writes the bits of an entropy-coded segment: the first bit is the highest of the first byte. A zero byte follows each
//! byte 0xFF, so that the segment contains no markers.

/// Bits of the word that collects bits.
const WORD_BITS: u32 = u64::BITS;
/// Most bytes that the writer stores beyond those of complete words: one word with a zero after each byte.
const SLACK_BYTES: usize = 16;

/// Writes bits to a buffer, whose content it replaces.
pub(super) struct BitWriter<'a> {
    bytes: &'a mut Vec<u8>,
    /// Number of bytes that are complete.
    position: usize,
    /// Bits that are not stored yet, the last one lowest. Bits above them are undefined.
    word: u64,
    /// Number of bits until the word is full.
    free_bits: u32,
}

impl<'a> BitWriter<'a> {
    pub(super) const fn new(bytes: &'a mut Vec<u8>) -> Self {
        Self { bytes, position: 0, word: 0, free_bits: WORD_BITS }
    }

    /// Makes room for this number of bytes. Bits without room are dropped.
    #[inline(always)]
    pub(super) fn reserve(&mut self, byte_count: usize) {
        let needed = self.position + byte_count + SLACK_BYTES;
        if self.bytes.len() < needed {
            grow(self.bytes, needed);
        }
    }

    /// Appends the lowest `count` bits of `bits`, at most 31. Its other bits must be 0.
    #[inline(always)]
    pub(super) fn write(&mut self, bits: u32, count: u32) {
        if count <= self.free_bits {
            self.word = self.word.wrapping_shl(count) | u64::from(bits);
            self.free_bits = self.free_bits.wrapping_sub(count);
        } else {
            let rest = count.wrapping_sub(self.free_bits);
            self.word = self.word.wrapping_shl(self.free_bits) | u64::from(bits.wrapping_shr(rest));
            self.store_word();
            self.word = u64::from(bits);
            self.free_bits = WORD_BITS.wrapping_sub(rest);
        }
    }

    /// Stores a full word.
    #[inline(always)]
    fn store_word(&mut self) {
        // The highest bit of a byte of `carries` is set if the byte of the word is 0xFF. Carries between bytes start in
        // a byte 0xFF only, so the sum finds each word that has one.
        const LOW_BITS: u64 = 0x0101_0101_0101_0101;
        const HIGH_BITS: u64 = 0x8080_8080_8080_8080;
        let carries = self.word & HIGH_BITS & !self.word.wrapping_add(LOW_BITS);
        if carries != 0 {
            self.position = store_stuffed(self.bytes, self.position, self.word);
            return;
        }
        if let Some(target) = self.bytes.get_mut(self.position..).and_then(<[u8]>::first_chunk_mut) {
            *target = self.word.to_be_bytes();
            self.position = self.position.wrapping_add(8);
        }
    }

    /// Fills the last byte with ones. Returns all bytes.
    pub(super) fn finish(mut self) -> &'a [u8] {
        let bit_count = WORD_BITS - self.free_bits;
        let padding = bit_count.next_multiple_of(8) - bit_count;
        self.reserve(0);
        self.write((1 << padding) - 1, padding);
        let byte_count = (WORD_BITS - self.free_bits) / 8;
        for index in (0..byte_count).rev() {
            self.position = store_byte(self.bytes, self.position, (self.word >> (8 * index)) as u8);
        }
        &self.bytes[..self.position]
    }
}

// These functions do not borrow the writer, so that its fields stay in registers.

#[cold]
fn grow(bytes: &mut Vec<u8>, needed: usize) {
    bytes.resize(2 * needed, 0);
}

/// Stores a word with a byte 0xFF at a position. Returns the position after it.
#[cold]
fn store_stuffed(bytes: &mut [u8], position: usize, word: u64) -> usize {
    word.to_be_bytes().into_iter().fold(position, |position, byte| store_byte(bytes, position, byte))
}

fn store_byte(bytes: &mut [u8], position: usize, byte: u8) -> usize {
    let Some(target) = bytes.get_mut(position..).and_then(<[u8]>::first_chunk_mut) else { return position };
    *target = [byte, 0];
    position + if byte == u8::MAX { 2 } else { 1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bytes of bits by their definition, bit by bit.
    fn reference(parts: &[(u32, u32)]) -> Vec<u8> {
        let bit = |bits: u32, index: u32| bits >> index & 1;
        let all = parts.iter().flat_map(|(bits, count)| (0..*count).rev().map(|index| bit(*bits, index)));
        let mut all: Vec<u32> = all.collect();
        all.resize(all.len().next_multiple_of(8), 1);
        let byte = |bits: &[u32]| bits.iter().fold(0, |byte, bit| byte << 1 | *bit as u8);
        let stuffed = |byte: u8| std::iter::once(byte).chain((byte == 255).then_some(0));
        all.chunks(8).map(byte).flat_map(stuffed).collect()
    }

    #[test]
    fn bits_fill_bytes_from_the_highest() {
        let mut random = fastrand::Rng::with_seed(1);
        let mut buffer = vec![7; 3];
        for count in [0, 1, 2, 3, 4, 10, 100, 1000] {
            for ones_in_8 in [0, 4, 7, 8] {
                let mut part = || {
                    let count = random.u32(1..=31);
                    let bits = (0..count).fold(0, |bits, _| bits << 1 | u32::from(random.u32(0..8) < ones_in_8));
                    (bits, count)
                };
                let parts: Vec<(u32, u32)> = (0..count).map(|_| part()).collect();
                let mut writer = BitWriter::new(&mut buffer);
                for (bits, count) in &parts {
                    writer.reserve(8);
                    writer.write(*bits, *count);
                }
                assert!(writer.finish() == reference(&parts), "{count} parts, {ones_in_8}");
            }
        }
    }
}
