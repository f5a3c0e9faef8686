//! One step of a physics process: r coordinates and a transform per domain, packed little-endian.

use bytes::{Bytes, BytesMut};
use modalcast_proto::v1;
use prost::Message as _;

use crate::error::{Error, Result};

/// The transform `world_from_domain` of a domain, in scene units. A rotation is a quaternion x, y, z, w (w is the real
/// part) with a norm of 1 within 0.001; the server normalizes it in f64.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DomainTransform {
    /// 48 bytes: row-major 3x4, with a translation relative to the scene's origin. It may shear and scale if the scene
    /// allows it.
    Affine([f32; 12]),
    /// 28 bytes: the rotation, then a translation relative to the scene's origin.
    QuaternionXyzwF32 { rotation: [f32; 4], translation: [f32; 3] },
    /// 40 bytes: the rotation, then a translation relative to the world's origin. The server subtracts the scene's
    /// origin in f64. Resolves millimeters at 10,000 km.
    QuaternionXyzwF64 { rotation: [f32; 4], translation: [f64; 3] },
}

impl DomainTransform {
    const fn format(&self) -> v1::TransformFormat {
        match self {
            // Means affine, also to a server that does not know the other formats.
            Self::Affine(_) => v1::TransformFormat::Unspecified,
            Self::QuaternionXyzwF32 { .. } => v1::TransformFormat::QuaternionXyzwF32,
            Self::QuaternionXyzwF64 { .. } => v1::TransformFormat::QuaternionXyzwF64,
        }
    }

    fn append_to(&self, bytes: &mut BytesMut) {
        match self {
            Self::Affine(entries) => append_numbers(bytes, entries),
            Self::QuaternionXyzwF32 { rotation, translation } => {
                append_numbers(bytes, rotation);
                append_numbers(bytes, translation);
            }
            Self::QuaternionXyzwF64 { rotation, translation } => {
                append_numbers(bytes, rotation);
                append_numbers(bytes, translation);
            }
        }
    }
}

/// Appends the bytes of numbers; `assemble` checks at compile time that the host is little-endian.
fn append_numbers<T: bytemuck::NoUninit>(bytes: &mut BytesMut, numbers: &[T]) {
    bytes.extend_from_slice(bytemuck::cast_slice(numbers));
}

/// The coordinates and transforms of one step. Values that are not set do not change on the server.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Step {
    number: u64,
    time: f64,
    q_domains: Vec<u32>,
    q: BytesMut,
    transform_domains: Vec<u32>,
    transforms: BytesMut,
    /// The format of the first transform.
    format: v1::TransformFormat,
    /// Whether a later transform has another format.
    has_mixed_formats: bool,
}

impl Step {
    /// An empty step. Step numbers increase within one stream; `time` is the simulation time in seconds.
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

    /// Sets the transform of a domain, in any of the three formats. All transforms of one step must have the same
    /// format.
    #[must_use]
    pub fn domain_transform(mut self, domain: u32, transform: &DomainTransform) -> Self {
        self.set_domain_transform(domain, transform);
        self
    }

    /// As [`Self::q`], in place.
    pub fn set_q(&mut self, domain: u32, coordinates: &[f32]) {
        self.q_domains.push(domain);
        append_numbers(&mut self.q, coordinates);
    }

    /// As [`Self::transform`], in place.
    pub fn set_transform(&mut self, domain: u32, world_from_domain: &[f32; 12]) {
        self.set_domain_transform(domain, &DomainTransform::Affine(*world_from_domain));
    }

    /// As [`Self::domain_transform`], in place.
    pub fn set_domain_transform(&mut self, domain: u32, transform: &DomainTransform) {
        if self.transform_domains.is_empty() {
            self.format = transform.format();
        }
        self.has_mixed_formats |= self.format != transform.format();
        self.transform_domains.push(domain);
        transform.append_to(&mut self.transforms);
    }

    /// Checks that all transforms have the same format, because one message has one format.
    pub(crate) fn check_formats(&self) -> Result<()> {
        if self.has_mixed_formats {
            return Err(Error::Step { step: self.number, reason: "expected transforms of one format, got several" });
        }
        Ok(())
    }

    /// The step's number.
    pub const fn number(&self) -> u64 {
        self.number
    }

    /// Bytes of coordinates and transforms.
    pub fn payload_bytes(&self) -> usize {
        self.q.len() + self.transforms.len()
    }

    /// The step in its wire format, in parts of about 512 KiB if it is larger than 1 MiB.
    pub(crate) fn to_wire_parts(&self) -> Vec<v1::Step> {
        split_step(self.to_wire())
    }

    /// The step in its wire format, as one message.
    pub fn to_wire(&self) -> v1::Step {
        v1::Step {
            number: self.number,
            time: self.time,
            q_domains: self.q_domains.clone(),
            q: self.q.clone().freeze(),
            transform_domains: self.transform_domains.clone(),
            transforms: self.transforms.clone().freeze(),
            transform_format: self.format.into(),
            has_more: false,
            shared_q: None,
            shared_transforms: None,
        }
    }
}

/// A step up to this size is one message. In bytes.
const MAX_SINGLE_BYTES: usize = 1 << 20;

/// Size of a part of a larger step, in bytes.
const PART_BYTES: usize = 512 << 10;

/// Maximum number of domain indices in one part. An index takes at most 5 bytes on the wire.
const PART_DOMAINS: usize = PART_BYTES / 5;

/// Splits a step that is larger than [`MAX_SINGLE_BYTES`]. Each part has a piece of one list or of one array.
fn split_step(step: v1::Step) -> Vec<v1::Step> {
    if step.encoded_len() <= MAX_SINGLE_BYTES {
        return vec![step];
    }
    let v1::Step { number, time, q_domains, q, transform_domains, transforms, transform_format, .. } = step;
    // The first part has what applies to all parts.
    let mut parts = vec![v1::Step { number, time, transform_format, ..v1::Step::default() }];
    let empty = || v1::Step { number, ..v1::Step::default() };
    parts.extend(q_domains.chunks(PART_DOMAINS).map(|piece| v1::Step { q_domains: piece.to_vec(), ..empty() }));
    parts.extend(pieces(q).map(|q| v1::Step { q, ..empty() }));
    let domain_pieces = transform_domains.chunks(PART_DOMAINS);
    parts.extend(domain_pieces.map(|piece| v1::Step { transform_domains: piece.to_vec(), ..empty() }));
    parts.extend(pieces(transforms).map(|transforms| v1::Step { transforms, ..empty() }));
    let last_part = parts.len() - 1;
    parts[..last_part].iter_mut().for_each(|part| part.has_more = true);
    parts
}

/// Splits bytes into pieces of [`PART_BYTES`].
fn pieces(bytes: Bytes) -> impl Iterator<Item = Bytes> {
    (0..bytes.len()).step_by(PART_BYTES).map(move |start| bytes.slice(start..bytes.len().min(start + PART_BYTES)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_packed_little_endian_in_domain_order() {
        let transform = [1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 6.0, 0.0, 0.0, 1.0, 7.0];
        let wire = Step::new(3, 0.5).q(2, &[1.0, -2.0]).q(0, &[0.25]).transform(1, &transform).to_wire();
        assert_eq!((wire.number, wire.time), (3, 0.5));
        assert_eq!(wire.q_domains, [2, 0]);
        let bytes: Vec<u8> = [1.0_f32, -2.0, 0.25].iter().flat_map(|number| number.to_le_bytes()).collect();
        assert_eq!(wire.q, bytes);
        assert_eq!((&wire.transform_domains, wire.transforms.len()), (&vec![1], 48));
        // Entry 3 of the matrix: the x component of the translation.
        assert_eq!(wire.transforms[12..16], 5.0_f32.to_le_bytes());
        assert_eq!(wire.transform_format(), v1::TransformFormat::Unspecified);
    }

    #[test]
    fn quaternion_formats_start_with_rotation_and_do_not_mix() {
        let rotation = [0.0, 0.6, 0.0, 0.8];
        let quaternion_f32 = DomainTransform::QuaternionXyzwF32 { rotation, translation: [1.0, 2.0, 3.0] };
        let quaternion_f64 = DomainTransform::QuaternionXyzwF64 { rotation, translation: [1e7, 2.0, 3.25] };
        let step = Step::new(0, 0.0).domain_transform(4, &quaternion_f32).domain_transform(2, &quaternion_f32);
        // Two f32 transforms of 28 bytes.
        assert_eq!((step.check_formats().is_ok(), step.payload_bytes()), (true, 2 * 28));
        let wire = step.clone().to_wire();
        assert_eq!(
            (wire.transform_domains.as_slice(), wire.transform_format()),
            ([4, 2].as_slice(), v1::TransformFormat::QuaternionXyzwF32)
        );
        // The y component of the rotation, and the z component of the translation.
        assert_eq!(
            (&wire.transforms[4..8], &wire.transforms[24..28]),
            (&0.6_f32.to_le_bytes()[..], &3.0_f32.to_le_bytes()[..])
        );
        let wire = Step::new(0, 0.0).domain_transform(1, &quaternion_f64).to_wire();
        assert_eq!((wire.transforms.len(), wire.transform_format()), (40, v1::TransformFormat::QuaternionXyzwF64));
        // The real part of the rotation, and the x component of the translation.
        assert_eq!(
            (&wire.transforms[12..16], &wire.transforms[16..24]),
            (&0.8_f32.to_le_bytes()[..], &1e7_f64.to_le_bytes()[..])
        );
        for step in [step.clone().domain_transform(1, &quaternion_f64), step.transform(1, &[0.0; 12])] {
            let error = step.check_formats().expect_err("mixed formats").to_string();
            assert_eq!(error, "step 0 cannot be sent: expected transforms of one format, got several");
        }
    }

    #[test]
    fn large_step_is_split_into_parts_without_loss() {
        let mut step = Step::new(3, 0.5);
        for domain in 0..60_000 {
            step.set_q(domain, &[domain as f32]);
            step.set_transform(domain, &[domain as f32; 12]);
        }
        let (whole, parts) = (step.to_wire(), step.to_wire_parts());
        assert!(parts.len() > 5, "{}", parts.len());
        assert!(parts.iter().all(|part| part.encoded_len() <= PART_BYTES + 100 && part.number == 3));
        let more: Vec<bool> = parts.iter().map(|part| part.has_more).collect();
        assert!(more[..more.len() - 1].iter().all(|has_more| *has_more) && !more[more.len() - 1]);
        assert_eq!(parts[0].time, 0.5);
        let q: Vec<u8> = parts.iter().flat_map(|part| part.q.to_vec()).collect();
        let transforms: Vec<u8> = parts.iter().flat_map(|part| part.transforms.to_vec()).collect();
        let transform_domains: Vec<u32> = parts.iter().flat_map(|part| part.transform_domains.clone()).collect();
        assert!(q == whole.q && transforms == whole.transforms && transform_domains == whole.transform_domains);
        let small = Step::new(4, 0.0).q(0, &[1.0]);
        assert_eq!(small.to_wire_parts(), [small.to_wire()]);
    }
}
