//! One step as a physics process builds it: per domain r coordinates and a 3x4 transform, packed little-endian.

use bytes::{BufMut as _, BytesMut};
use modalcast_proto::v1;

/// A step under construction. What is not set keeps its value on the server.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Step {
    number: u64,
    time: f64,
    q_domains: Vec<u32>,
    q: BytesMut,
    transform_domains: Vec<u32>,
    transforms: BytesMut,
}

impl Step {
    /// An empty step. Numbers grow within one stream; `time` is simulation time in seconds.
    pub fn new(number: u64, time: f64) -> Self {
        Self { number, time, ..Self::default() }
    }

    /// Sets the coordinates of a domain: r numbers.
    #[must_use]
    pub fn q(mut self, domain: u32, coordinates: &[f32]) -> Self {
        self.set_q(domain, coordinates);
        self
    }

    /// Sets the transform of a domain: row-major 3x4 `world_from_domain`, relative to the scene's origin.
    #[must_use]
    pub fn transform(mut self, domain: u32, world_from_domain: &[f32; 12]) -> Self {
        self.set_transform(domain, world_from_domain);
        self
    }

    /// As [`Self::q`], in place.
    pub fn set_q(&mut self, domain: u32, coordinates: &[f32]) {
        self.q_domains.push(domain);
        coordinates.iter().for_each(|number| self.q.put_f32_le(*number));
    }

    /// As [`Self::transform`], in place.
    pub fn set_transform(&mut self, domain: u32, world_from_domain: &[f32; 12]) {
        self.transform_domains.push(domain);
        world_from_domain.iter().for_each(|number| self.transforms.put_f32_le(*number));
    }

    /// The step's number.
    pub const fn number(&self) -> u64 {
        self.number
    }

    /// Bytes of coordinates and transforms.
    pub fn payload(&self) -> usize {
        self.q.len() + self.transforms.len()
    }

    /// The step as the wire carries it.
    pub fn to_wire(&self) -> v1::Step {
        v1::Step {
            number: self.number,
            time: self.time,
            q_domains: self.q_domains.clone(),
            q: self.q.clone().freeze(),
            transform_domains: self.transform_domains.clone(),
            transforms: self.transforms.clone().freeze(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_packed_little_endian_in_the_order_of_their_domains() {
        let pose = [1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 6.0, 0.0, 0.0, 1.0, 7.0];
        let wire = Step::new(3, 0.5).q(2, &[1.0, -2.0]).q(0, &[0.25]).transform(1, &pose).to_wire();
        assert_eq!((wire.number, wire.time), (3, 0.5));
        assert_eq!(wire.q_domains, [2, 0]);
        let bytes: Vec<u8> = [1.0_f32, -2.0, 0.25].iter().flat_map(|number| number.to_le_bytes()).collect();
        assert_eq!(wire.q, bytes);
        assert_eq!((wire.transform_domains, wire.transforms.len()), (vec![1], 48));
        assert_eq!(wire.transforms[12..16], 5.0_f32.to_le_bytes());
    }
}
