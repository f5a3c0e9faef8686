//! Forces that a viewer applies to a scene, and the stream of all forces for a physics process. The server stores
//! forces until they expire; it does not simulate.

use std::pin::Pin;
use std::task::{Context, Poll};

use modalcast_proto::v1;
use v1::force::Kind;
use v1::force_service_client::ForceServiceClient;

use crate::assemble::{DecodedReplies, ReplyDecoder, decode};
use crate::client::Client;
use crate::error::{Result, malformed_reply};
use crate::pick::Hit;

/// A force at a point of a triangle, which moves with the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceForce {
    /// Index of the triangle in its domain.
    pub triangle: u32,
    /// Weights of the vertices of the triangle, with sum 1.
    pub barycentric: [f64; 3],
    /// In newtons, in world axes.
    pub vector: [f64; 3],
}

/// How a force acts on its domain.
#[derive(Debug, Clone, PartialEq)]
pub enum ForceKind {
    Surface(SurfaceForce),
    /// On the r coordinates of the domain: f_q.
    Modal(Vec<f32>),
}

/// A force on a domain.
#[derive(Debug, Clone, PartialEq)]
pub struct Force {
    /// Identifies the force among those of its owner, which must have different ids.
    pub id: u64,
    pub domain: u32,
    pub kind: ForceKind,
}

impl Force {
    /// A force in newtons and world axes at a picked point.
    pub const fn at_hit(id: u64, hit: &Hit, vector: [f64; 3]) -> Self {
        let surface = SurfaceForce { triangle: hit.triangle, barycentric: hit.barycentric, vector };
        Self { id, domain: hit.domain, kind: ForceKind::Surface(surface) }
    }

    /// A force on the r coordinates of a domain.
    pub fn on_modes(id: u64, domain: u32, f_q: &[f32]) -> Self {
        Self { id, domain, kind: ForceKind::Modal(f_q.to_vec()) }
    }

    fn to_wire(&self) -> v1::Force {
        let kind = match &self.kind {
            ForceKind::Surface(SurfaceForce { triangle, barycentric, vector }) => Kind::Surface(v1::SurfaceForce {
                triangle: *triangle,
                barycentric: barycentric.to_vec(),
                vector: vector.to_vec(),
            }),
            ForceKind::Modal(f_q) => Kind::Modal(v1::ModalForce { f_q: bytemuck::cast_slice(f_q).to_vec().into() }),
        };
        v1::Force { id: self.id, domain: self.domain, kind: Some(kind) }
    }
}

/// All forces of one owner in a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct ForceRequest {
    pub scene: String,
    /// 16 to 64 random bytes that identify the owner; a viewer keeps them.
    pub owner: Vec<u8>,
    /// Empty removes all forces of the owner.
    pub forces: Vec<Force>,
    /// Time in milliseconds after which the forces expire unless they are applied again; 0 for the server's default.
    pub lifetime_ms: u32,
}

impl ForceRequest {
    /// A request without forces and with the server's default lifetime.
    pub fn new(scene: &str, owner: &[u8]) -> Self {
        Self { scene: scene.to_owned(), owner: owner.to_vec(), forces: Vec::new(), lifetime_ms: 0 }
    }

    /// Adds a force.
    #[must_use]
    pub fn force(mut self, force: Force) -> Self {
        self.forces.push(force);
        self
    }

    /// Sets [`Self::lifetime_ms`].
    #[must_use]
    pub const fn lifetime_ms(mut self, lifetime_ms: u32) -> Self {
        self.lifetime_ms = lifetime_ms;
        self
    }
}

/// A force of any owner, and its effect.
#[derive(Debug, Clone, PartialEq)]
pub struct AppliedForce {
    /// Public number of the owner.
    pub owner: u64,
    /// As chosen by the owner.
    pub id: u64,
    pub domain: u32,
    /// `None` for a force on the coordinates.
    pub surface: Option<SurfaceForce>,
    /// The force on the coordinates of the domain: r numbers. For a force f on the surface, it is U^T A^T f, where A is
    /// the linear part of the domain's transform at [`ForceSet::step`].
    pub f_q: Vec<f32>,
    /// The point of a force on the surface at rest, in scene units and in the domain's own frame. `None` for a force on
    /// the coordinates.
    pub rest_point: Option<[f64; 3]>,
}

/// All forces in a scene.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ForceSet {
    /// The step with whose transforms the forces on the surface were converted to `f_q`; `None` if there are no forces
    /// on the surface.
    pub step: Option<v1::StepId>,
    /// Ordered by owner.
    pub forces: Vec<AppliedForce>,
}

impl Client {
    /// Sets all forces of an owner. Apply them again before their lifetime ends to keep them.
    ///
    /// # Errors
    /// `Status` if the scene does not exist, a force is invalid or a limit is reached; `Connect` if the connection is
    /// lost.
    pub async fn apply_forces(&self, request: &ForceRequest) -> Result<v1::ApplyForcesResponse> {
        let wire = v1::ApplyForcesRequest {
            scene: request.scene.clone(),
            owner: request.owner.clone().into(),
            forces: request.forces.iter().map(Force::to_wire).collect(),
            lifetime_ms: request.lifetime_ms,
        };
        self.reply(ForceServiceClient::new(self.channel.clone()).apply_forces(wire).await)
    }

    /// Subscribes to the forces of a scene: the present ones first, then all forces after every change, but at most
    /// `max_hz` times per second; 0 for no limit.
    ///
    /// # Errors
    /// `Status` if the scene does not exist or `max_hz` is invalid; `Connect` if the connection is lost.
    pub async fn stream_forces(&self, scene: &str, max_hz: f64) -> Result<ForceStream> {
        let wire = v1::StreamForcesRequest { scene: scene.to_owned(), max_hz, passive: false };
        let messages = self.replies(ForceServiceClient::new(self.undecoded_channel()).stream_forces(wire).await)?;
        Ok(ForceStream(DecodedReplies::new(messages, ForceDecoder)))
    }
}

/// A stream of forces; dropping it unsubscribes.
pub struct ForceStream(DecodedReplies<v1::StreamForcesResponse, ForceDecoder>);

impl ForceStream {
    /// All forces after the next change. `None` only if the server ends the stream without an error.
    pub async fn next(&mut self) -> Option<Result<ForceSet>> {
        self.0.next().await
    }
}

impl tokio_stream::Stream for ForceStream {
    type Item = Result<ForceSet>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll(context)
    }
}

/// Decodes messages, each of which has all forces.
struct ForceDecoder;

impl ReplyDecoder<v1::StreamForcesResponse> for ForceDecoder {
    type Reply = ForceSet;

    fn add_message(&mut self, message: v1::StreamForcesResponse) -> Result<Option<ForceSet>> {
        let forces = message.forces.into_iter().map(decode_force).collect::<Result<_>>()?;
        Ok(Some(ForceSet { step: message.step, forces }))
    }

    fn is_open(&self) -> bool {
        false
    }
}

fn decode_force(wire: v1::AppliedForce) -> Result<AppliedForce> {
    let force = wire.force.ok_or_else(|| malformed_reply("forces.force", "a force", "none"))?;
    let surface = match force.kind {
        Some(Kind::Surface(surface)) => Some(SurfaceForce {
            triangle: surface.triangle,
            barycentric: three_numbers("forces.surface.barycentric", &surface.barycentric)?,
            vector: three_numbers("forces.surface.vector", &surface.vector)?,
        }),
        // A kind of a newer server also acts on the coordinates as f_q.
        Some(Kind::Modal(_)) | None => None,
    };
    let f_q = decode("forces.f_q", &wire.f_q)?;
    let rest_point = match (&surface, wire.rest_point.is_empty()) {
        (None, true) => None,
        _ => Some(three_numbers("forces.rest_point", &wire.rest_point)?),
    };
    Ok(AppliedForce { owner: wire.owner, id: force.id, domain: force.domain, surface, f_q, rest_point })
}

fn three_numbers(field: &str, numbers: &[f64]) -> Result<[f64; 3]> {
    numbers.try_into().map_err(|_| malformed_reply(field, "three numbers", numbers.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn malformed_forces_report_their_field() {
        let surface = v1::SurfaceForce { triangle: 3, barycentric: vec![0.0, 0.5, 0.5], vector: vec![1.0, 2.0, 3.0] };
        let wire_force = |surface| v1::Force { id: 4, domain: 5, kind: Some(Kind::Surface(surface)) };
        let valid = v1::AppliedForce {
            owner: 1,
            force: Some(wire_force(surface.clone())),
            f_q: vec![0; 8].into(),
            rest_point: vec![0.0, -1.0, 0.5],
        };
        let force = decode_force(valid.clone()).expect("a valid force");
        let expected_surface = SurfaceForce { triangle: 3, barycentric: [0.0, 0.5, 0.5], vector: [1.0, 2.0, 3.0] };
        assert_eq!((force.id, force.domain, force.surface), (4, 5, Some(expected_surface)));
        assert_eq!((force.f_q, force.rest_point), (vec![0.0, 0.0], Some([0.0, -1.0, 0.5])));
        let without_vector = v1::SurfaceForce { vector: vec![], ..surface };
        for (wire, field) in [
            (v1::AppliedForce { force: None, ..valid.clone() }, "forces.force"),
            (v1::AppliedForce { f_q: vec![0; 7].into(), ..valid.clone() }, "forces.f_q"),
            (v1::AppliedForce { rest_point: vec![], ..valid.clone() }, "forces.rest_point"),
            (v1::AppliedForce { rest_point: vec![0.0; 2], ..valid.clone() }, "forces.rest_point"),
            (v1::AppliedForce { force: Some(wire_force(without_vector)), ..valid }, "forces.surface.vector"),
        ] {
            let error = decode_force(wire).expect_err(field).to_string();
            assert!(error.contains(field), "expected {field}, got {error}");
        }
    }
}
