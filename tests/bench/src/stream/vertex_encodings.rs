//! Encodings of vertices: bytes, times, and errors against f32 with their bounds, which `vertices.proto` states.

use std::future::poll_fn;
use std::pin::Pin;
use std::time::{Duration, Instant};

use modalcast_client::{
    Attribute, Client, Encoding, StageSamples, VertexRequest, VertexSelection, VertexSet, VertexStreamRequest,
};
use serde::Serialize;
use tokio_stream::Stream;

use super::SCENE;
use super::StreamReportOptions;
use super::motion::{self, Motion};
use super::session::Session;
use crate::timing::quantile;
use crate::workloads::Size;
use modalcast_model::error::{Result, fault, fault_in};

/// Number of vectors that share a box.
const BOX_VECTORS: usize = 256;

/// Bound of the relative error of f16, and bound of the absolute error of numbers below its normal range.
const F16_RELATIVE_BOUND: f64 = 1.0 / 2048.0;
const F16_SMALL_BOUND: f64 = 1.0 / 33_554_432.0;

/// Relative bound of rounding to f32.
const F32_ROUNDING: f64 = 1.0 / 16_777_216.0;

/// Bound of the angle of octahedral normals in degrees.
const OCTAHEDRAL_BOUND_DEGREES: f64 = 0.004;

/// The measured attributes with their encodings. The first encoding of each is the reference.
const CASES: [(Attribute, Encoding); 6] = [
    (Attribute::Positions, Encoding::F32),
    (Attribute::Positions, Encoding::F16),
    (Attribute::Positions, Encoding::U16Box),
    (Attribute::Normals, Encoding::F32),
    (Attribute::Normals, Encoding::F16),
    (Attribute::Normals, Encoding::OctahedralI16),
];

/// One encoding of one attribute.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct VertexEncodingRow {
    pub attribute: &'static str,
    pub encoding: &'static str,
    /// Bytes of a step, with the origin if the reply has one.
    pub bytes: u64,
    /// Median time of the server's stage `encode`.
    pub pack_ms: f64,
    /// Median time that the client's stream works on a step: it assembles the chunks and decodes the numbers to f32.
    /// The time in which it waits for bytes is not included.
    pub decode_ms: f64,
    pub errors: EncodingErrors,
}

impl VertexEncodingRow {
    /// The unit of the errors.
    pub(super) fn error_unit(&self) -> &'static str {
        if self.attribute == "positions" { "m" } else { "degrees" }
    }
}

/// Errors against f32: of each coordinate of a position in meters, or angles of normals in degrees.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct EncodingErrors {
    pub largest: f64,
    pub rms: f64,
    /// The largest bound of all numbers; 0 for f32.
    pub bound: f64,
    /// The largest quotient of an error and its own bound; 0 for f32. A value above 1 is a failure.
    pub of_bound: f64,
}

/// Accumulates errors.
#[derive(Debug, Default)]
struct ErrorSum {
    errors: EncodingErrors,
    sum_of_squares: f64,
    count: usize,
}

impl ErrorSum {
    fn add(&mut self, error: f64, bound: f64) {
        let errors = &mut self.errors;
        (errors.largest, errors.bound) = (errors.largest.max(error), errors.bound.max(bound));
        // An exact number is within a bound of 0.
        let of_bound = if error == 0.0 { 0.0 } else { error / bound };
        errors.of_bound = errors.of_bound.max(of_bound);
        self.sum_of_squares += error * error;
        self.count += 1;
    }

    fn finish(self) -> EncodingErrors {
        EncodingErrors { rms: (self.sum_of_squares / self.count.max(1) as f64).sqrt(), ..self.errors }
    }
}

/// Measures all encodings of positions and normals.
///
/// # Errors
/// `Fault` when the server rejects a request or replies with other vertices.
pub(super) fn measure(session: &Session, options: &StreamReportOptions) -> Result<Vec<VertexEncodingRow>> {
    let (timed_steps, compared_steps) = match options.size {
        Size::Full => (60, 6),
        Size::Quick => (6, 2),
    };
    let motion = session.motion(options.steps.min(super::RECORDED_STEPS))?;
    let unit = session.scene_info.unit;
    session.runtime.block_on(async {
        let errors = measure_errors(&session.client, motion, compared_steps, unit).await?;
        let mut rows = Vec::new();
        for ((attribute, encoding), errors) in CASES.into_iter().zip(errors) {
            let times = time_stream(&session.client, motion, timed_steps, (attribute, encoding)).await?;
            rows.push(VertexEncodingRow {
                attribute: if attribute == Attribute::Positions { "positions" } else { "normals" },
                encoding: encoding_name(encoding),
                bytes: times.bytes,
                pack_ms: times.pack_ms,
                decode_ms: times.decode_ms,
                errors,
            });
        }
        Ok(rows)
    })
}

const fn encoding_name(encoding: Encoding) -> &'static str {
    match encoding {
        Encoding::Unspecified | Encoding::F32 => "f32",
        Encoding::F16 => "f16",
        Encoding::U16Box => "u16 in boxes",
        Encoding::OctahedralI16 => "octahedral i16",
        Encoding::F64 => "f64",
    }
}

fn selection(case: (Attribute, Encoding)) -> VertexSelection {
    VertexSelection::default().encoded_attribute(case.0, case.1)
}

/// The errors of all [`CASES`], each over several steps.
async fn measure_errors(client: &Client, motion: &Motion, steps: u64, unit: f64) -> Result<Vec<EncodingErrors>> {
    let mut writer = motion::open_writer(client, None).await?;
    let mut sums: Vec<ErrorSum> = CASES.iter().map(|_| ErrorSum::default()).collect();
    for number in 0..steps {
        writer.step(&motion.step(number)).await.map_err(fault_in("report"))?;
        writer.flush().await.map_err(fault_in("report"))?;
        let mut reference: Option<VertexSet> = None;
        for (case, sum) in CASES.into_iter().zip(&mut sums) {
            let request = VertexRequest::new(SCENE, selection(case)).exact_step(number);
            let set = client.get_vertices(&request).await.map_err(fault_in("report"))?;
            if case.1 == Encoding::F32 {
                reference = Some(set.clone());
            }
            let reference = reference.as_ref().ok_or_else(|| fault("report", "expected f32 first"))?;
            match case.0 {
                Attribute::Normals => add_normals(sum, case.1, [&reference.normals, &set.normals])?,
                _ => add_positions(sum, case.1, unit, [&reference.positions, &set.positions])?,
            }
        }
    }
    writer.finish().await.map_err(fault_in("report"))?;
    Ok(sums.into_iter().map(ErrorSum::finish).collect())
}

fn check_lengths([reference, received]: [&[f32]; 2]) -> Result<()> {
    match !reference.is_empty() && reference.len() == received.len() {
        true => Ok(()),
        false => Err(fault("report", format!("expected {} numbers, got {}", reference.len(), received.len()))),
    }
}

/// Adds the errors of all coordinates of positions, in meters.
fn add_positions(sum: &mut ErrorSum, encoding: Encoding, unit: f64, positions: [&[f32]; 2]) -> Result<()> {
    check_lengths(positions)?;
    let [reference, received] = positions.map(|numbers| numbers.chunks(3 * BOX_VECTORS));
    for (reference, received) in reference.zip(received) {
        let extents: [f64; 3] = std::array::from_fn(|axis| {
            let of_axis = || reference.iter().skip(axis).step_by(3).map(|number| f64::from(*number));
            of_axis().fold(f64::NEG_INFINITY, f64::max) - of_axis().fold(f64::INFINITY, f64::min)
        });
        for (index, (expected, given)) in reference.iter().zip(received).enumerate() {
            let expected = f64::from(*expected);
            let bound = match encoding {
                Encoding::F16 => (F16_RELATIVE_BOUND * expected.abs()).max(F16_SMALL_BOUND),
                // Half of the step between two 16-bit codes, extent / 65,535, and the rounding of the result to f32.
                Encoding::U16Box => {
                    extents[index % 3] / 131_070.0 + F32_ROUNDING * (expected.abs() + extents[index % 3])
                }
                _ => 0.0,
            };
            sum.add(unit * (f64::from(*given) - expected).abs(), unit * bound);
        }
    }
    Ok(())
}

/// Adds the angles between normals, in degrees.
fn add_normals(sum: &mut ErrorSum, encoding: Encoding, normals: [&[f32]; 2]) -> Result<()> {
    check_lengths(normals)?;
    let bound = match encoding {
        // The error vector of a unit vector is at most the relative bound long.
        Encoding::F16 => (F16_RELATIVE_BOUND + F16_SMALL_BOUND).asin().to_degrees(),
        Encoding::OctahedralI16 => OCTAHEDRAL_BOUND_DEGREES,
        _ => 0.0,
    };
    let [reference, received] = normals.map(|numbers| numbers.as_chunks::<3>().0);
    for (reference, received) in reference.iter().zip(received) {
        let [a, b] = [reference, received].map(|vector| glam::Vec3::from_array(*vector).as_dvec3());
        sum.add(a.cross(b).length().atan2(a.dot(b)).to_degrees(), bound);
    }
    Ok(())
}

/// Size and times of a stream.
struct StreamTimes {
    bytes: u64,
    pack_ms: f64,
    decode_ms: f64,
}

async fn time_stream(client: &Client, motion: &Motion, steps: u64, case: (Attribute, Encoding)) -> Result<StreamTimes> {
    let request = VertexStreamRequest::new(SCENE, selection(case)).max_steps(steps);
    let mut vertices = client.stream_vertices(&request).await.map_err(fault_in("report"))?;
    let mut writer = motion::open_writer(client, None).await?;
    let (mut stages, mut decode_times_ms, mut bytes) = (StageSamples::default(), Vec::new(), 0);
    for number in 0..steps {
        writer.step(&motion.step(number)).await.map_err(fault_in("report"))?;
        let (set, busy) = next_timed(&mut vertices).await;
        let set = set.ok_or_else(|| fault("report", "expected another step"))?.map_err(fault_in("report"))?;
        stages.add(&set.stages);
        decode_times_ms.push(busy.as_secs_f64() * 1e3);
        bytes = set.encoded_bytes;
    }
    writer.finish().await.map_err(fault_in("report"))?;
    let pack_ms = stages.medians().get("encode").copied().map(f64::from);
    let missing = || fault("report", "expected the time of the stage 'encode'");
    Ok(StreamTimes {
        bytes,
        pack_ms: pack_ms.ok_or_else(missing)?,
        decode_ms: quantile(&mut decode_times_ms, 0.5).ok_or_else(missing)?,
    })
}

/// The next item of a stream, and the time in which the stream was not waiting.
async fn next_timed<S: Stream + Unpin>(stream: &mut S) -> (Option<S::Item>, Duration) {
    let mut busy = Duration::ZERO;
    let item = poll_fn(|context| {
        let start = Instant::now();
        let poll = Pin::new(&mut *stream).poll_next(context);
        busy += start.elapsed();
        poll
    })
    .await;
    (item, busy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn u16_error_counts_against_the_extent_of_its_box() {
        // Two boxes: the first 256 vectors span 2 in x, the last one is alone in its box.
        let mut reference = vec![0.0_f32; 3 * 257];
        reference[3] = 2.0;
        let mut received = reference.clone();
        received[0] = 1.5e-5; // 2 / 131070 is 1.53e-5.
        let errors_of = |received: &[f32]| {
            let mut sum = ErrorSum::default();
            add_positions(&mut sum, Encoding::U16Box, 2.0, [&reference, received]).expect("expected equal lengths");
            sum.finish()
        };
        let errors = errors_of(&received);
        assert!((errors.largest - 3e-5).abs() < 1e-9 && (0.9..1.0).contains(&errors.of_bound), "{errors:?}");
        // Controls: an error beyond the bound, and an error in a box without extent.
        received[0] = 1.6e-5;
        assert!(errors_of(&received).of_bound > 1.0);
        (received[0], received[3 * 256]) = (0.0, 1e-7);
        assert!(errors_of(&received).of_bound > 1.0);
        assert_eq!(errors_of(&reference).of_bound, 0.0);
        assert!(check_lengths([&reference, &received[3..]]).is_err());
    }

    #[test]
    fn f16_and_octahedral_errors_have_relative_and_angular_bounds() {
        let mut sum = ErrorSum::default();
        add_positions(&mut sum, Encoding::F16, 1.0, [&[1000.0, 0.0, 0.0], &[1000.25, 0.0, 2e-8]]).expect("equal");
        let errors = sum.finish();
        assert!((errors.of_bound - 2e-8 / F16_SMALL_BOUND).abs() < 0.01 && errors.largest == 0.25, "{errors:?}");
        let turned = |degrees: f32| [degrees.to_radians().cos(), degrees.to_radians().sin(), 0.0];
        for (degrees, is_within_bound) in [(0.0039, true), (0.0042, false)] {
            let mut sum = ErrorSum::default();
            let normals: [&[f32]; 2] = [&[1.0, 0.0, 0.0], &turned(degrees)];
            add_normals(&mut sum, Encoding::OctahedralI16, normals).expect("equal");
            let errors = sum.finish();
            assert_eq!(errors.of_bound <= 1.0, is_within_bound, "{errors:?}");
            assert!((errors.largest - f64::from(degrees)).abs() < 1e-5, "{errors:?}");
        }
    }
}
