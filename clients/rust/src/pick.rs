//! Picking: the surface point at a pixel of a picture, and U interpolated at that point. The interpolated U projects a
//! force at the point onto the modes.

use modalcast_proto::v1;
use v1::frame_service_client::FrameServiceClient;

use crate::assemble::decode;
use crate::client::Client;
use crate::error::{Result, malformed_reply};
use crate::frames::Picture;
use crate::request::StepRequest;
use crate::stages::{self, StageTimes};

/// Maximum number of hits of a reply, because the server accepts at most 64 x 64 pixels. The limit bounds memory if a
/// stream never ends.
const MAX_HITS: usize = 64 * 64;

/// A request for the surface points in a small rectangle of a picture.
pub type PickRequest = StepRequest<PickRectangle>;

/// A rectangle of pixels of a picture; at most 64 pixels a side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PickRectangle {
    /// Size and camera of the picture to which the pixel coordinates refer.
    pub picture: Picture,
    /// Column of the top left pixel of the rectangle, from the left of the picture.
    pub x: u32,
    /// Row of the top left pixel of the rectangle, from the top of the picture.
    pub y: u32,
    /// In pixels.
    pub width: u32,
    /// In pixels.
    pub height: u32,
    /// Whether the reply omits [`Hit::modes`].
    pub omit_modes: bool,
}

impl PickRectangle {
    /// One pixel of a picture, with [`Hit::modes`].
    pub const fn pixel(picture: Picture, x: u32, y: u32) -> Self {
        Self { picture, x, y, width: 1, height: 1, omit_modes: false }
    }

    /// Sets the size in pixels.
    #[must_use]
    pub const fn size(mut self, width: u32, height: u32) -> Self {
        (self.width, self.height) = (width, height);
        self
    }
}

/// The hits in a rectangle of pixels, row by row. A pixel that shows no triangle has no hit.
#[derive(Debug, Clone, PartialEq)]
pub struct PickResult {
    pub step: v1::StepId,
    pub hits: Vec<Hit>,
    pub stages: StageTimes,
}

/// The surface at the center of a pixel; `frames.proto` documents each field.
#[derive(Debug, Clone, PartialEq)]
pub struct Hit {
    /// Column and row in the picture.
    pub pixel: [u32; 2],
    pub domain: u32,
    /// Index of the triangle in its domain.
    pub triangle: u32,
    /// Vertex indices; vertex v has the rows 3v, 3v + 1 and 3v + 2 of U.
    pub vertices: [u32; 3],
    /// Weights in the order of `vertices`.
    pub barycentric: [f64; 3],
    /// In scene units, relative to the scene's origin.
    pub position: [f64; 3],
    /// Unit normal in world axes, facing the camera; zeros if the vertex normals cancel.
    pub normal: [f64; 3],
    /// In meters along the view axis.
    pub depth: f64,
    /// A, the linear part of the domain's transform, row-major 3x3.
    pub linear: [f32; 9],
    /// r, the number of columns of U.
    pub rank: usize,
    /// 3 x `rank`, row-major: U interpolated at the point; empty if the request omits it.
    pub modes: Vec<f32>,
}

impl Hit {
    /// The reduced force f_q = U^T A^T f of a force f at the point, in world axes. Empty without modes.
    pub fn reduced_force(&self, force: [f64; 3]) -> Vec<f64> {
        let local_force: [f64; 3] =
            std::array::from_fn(|row| (0..3).map(|axis| f64::from(self.linear[3 * axis + row]) * force[axis]).sum());
        // `modes` is a public field, so take the number of columns from its length rather than from `rank`.
        let column_count = self.modes.len() / 3;
        let component =
            |mode: usize| (0..3).map(|row| f64::from(self.modes[row * column_count + mode]) * local_force[row]).sum();
        (0..column_count).map(component).collect()
    }
}

impl Client {
    /// Picks in a rectangle of a picture.
    ///
    /// # Errors
    /// `Status` if the scene or the step does not exist, the rectangle is outside the picture, or the deadline passed;
    /// `Malformed` if the reply contradicts itself; `Connect` if the connection is lost.
    pub async fn pick(&self, request: &PickRequest) -> Result<PickResult> {
        let PickRectangle { picture, x, y, width, height, omit_modes } = request.query;
        let wire = v1::PickRequest {
            scene: request.scene.clone(),
            picture: Some(picture.into()),
            step: request.step.to_wire(),
            deadline_ms: request.deadline_ms,
            x,
            y,
            width,
            height,
            without_modes: omit_modes,
        };
        let mut messages = self.replies(FrameServiceClient::new(self.undecoded_channel()).pick(wire).await)?;
        let mut head = None;
        let mut hits = Vec::new();
        while let Some(response) = messages.next().await? {
            head = head.or(response.head);
            for wire in response.hits {
                hits.push(decode_hit(wire)?);
            }
            if hits.len() > MAX_HITS {
                return Err(malformed_reply("pick.hits", format!("at most {MAX_HITS}"), hits.len()));
            }
        }
        let head = head.ok_or_else(|| malformed_reply("pick.head", "a head", "none"))?;
        if head.hits as usize != hits.len() {
            return Err(malformed_reply("pick.hits", head.hits, hits.len()));
        }
        let step = head.step.ok_or_else(|| malformed_reply("pick.step", "a step", "none"))?;
        Ok(PickResult { step, hits, stages: stages::from_wire(head.stages) })
    }
}

fn decode_hit(wire: v1::Hit) -> Result<Hit> {
    // Three rows of `rank` f32.
    let mode_bytes = 12 * wire.rank as usize;
    if !wire.modes.is_empty() && wire.modes.len() != mode_bytes {
        return Err(malformed_reply("hit.modes", format!("none or {mode_bytes} bytes"), wire.modes.len()));
    }
    Ok(Hit {
        pixel: [wire.x, wire.y],
        domain: wire.domain,
        triangle: wire.triangle,
        vertices: to_array("hit.vertices", wire.vertices)?,
        barycentric: to_array("hit.barycentric", wire.barycentric)?,
        position: to_array("hit.position", wire.position)?,
        normal: to_array("hit.normal", wire.normal)?,
        depth: wire.depth,
        linear: to_array("hit.linear", wire.linear)?,
        rank: wire.rank as usize,
        modes: decode("hit.modes", &wire.modes)?,
    })
}

fn to_array<T, const N: usize>(field: &str, list: Vec<T>) -> Result<[T; N]> {
    list.try_into().map_err(|list: Vec<T>| malformed_reply(field, format!("{N} numbers"), list.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wire_hit() -> v1::Hit {
        v1::Hit {
            vertices: vec![1, 2, 3],
            barycentric: vec![0.5, 0.25, 0.25],
            position: vec![0.0; 3],
            normal: vec![0.0; 3],
            linear: vec![0.0, -2.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0],
            rank: 2,
            modes: [1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0].into_iter().flat_map(f32::to_le_bytes).collect(),
            ..v1::Hit::default()
        }
    }

    #[test]
    fn reduced_force_is_projected_onto_the_modes() {
        let hit = decode_hit(wire_hit()).expect("a valid hit");
        // A^T f = (2 f_y, -2 f_x, f_z), and the columns of U are (1, 3, 5) and (2, 4, 6).
        assert_eq!(hit.reduced_force([1.0, 0.0, 0.0]), [-6.0, -8.0]);
        assert_eq!(hit.reduced_force([0.0, 1.0, 10.0]), [52.0, 64.0]);
    }

    #[test]
    fn reduced_force_is_empty_without_modes() {
        let hit = decode_hit(v1::Hit { modes: bytes::Bytes::new(), ..wire_hit() }).expect("a valid hit");
        assert!(hit.reduced_force([1.0; 3]).is_empty());
    }

    #[test]
    fn malformed_hits_report_their_field() {
        for (wire, field) in [
            (v1::Hit { rank: 3, ..wire_hit() }, "hit.modes"),
            (v1::Hit { vertices: vec![1], ..wire_hit() }, "hit.vertices"),
            (v1::Hit { linear: vec![1.0; 8], ..wire_hit() }, "hit.linear"),
        ] {
            let error = decode_hit(wire).expect_err(field).to_string();
            assert!(error.contains(field), "{error}");
        }
    }
}
