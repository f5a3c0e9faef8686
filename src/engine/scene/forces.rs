//! Forces that viewers apply to a scene. An owner, identified by a token, sets all its forces at once; they expire
//! unless the owner renews them. The forces of a scene are independent of its task: they are stored behind a lock, and
//! their readers remove expired ones. Until forces are applied or read for the first time, a scene stores only an empty
//! cell for them.
//!
//! A reader receives the newest set of forces, so nothing is queued.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::lease::LeaseToken;
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Maximum number of forces of one owner in a scene.
const MAX_FORCES_PER_OWNER: usize = 16;

/// Maximum number of owners that have forces in a scene. All forces of a scene then fit into one message: 512 forces
/// with at most 512 coordinates take 1 MiB.
const MAX_OWNERS: usize = 32;

/// Maximum number of readers of the forces of a scene.
const MAX_READERS: usize = 32;

/// Lifetime of forces whose owner names none.
const DEFAULT_LIFETIME: Duration = Duration::from_millis(500);

/// Maximum lifetime of forces.
const MAX_LIFETIME: Duration = Duration::from_secs(10);

/// Maximum deviation of barycentric coordinates from a point of the triangle, which allows for rounding.
const BARYCENTRIC_TOLERANCE: f64 = 1e-3;

/// Maximum component of a force in newtons. Products with f32 numbers are then finite in f64.
const MAX_NEWTONS: f64 = 1e30;

/// A validated force on one domain of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Force {
    /// Chosen by the owner.
    pub id: u64,
    pub domain: u32,
    pub kind: ForceKind,
}

/// How a force acts on its domain.
#[derive(Debug, Clone, PartialEq)]
pub enum ForceKind {
    /// At a point of the surface.
    Surface {
        triangle: u32,
        barycentrics: [f64; 3],
        /// In world axes.
        newtons: [f64; 3],
    },
    /// On the r coordinates of the domain: f_q.
    Modal(Vec<f32>),
}

impl Force {
    /// A force at a point of a domain's surface. The fields of errors are relative to the force.
    ///
    /// # Errors
    /// `Invalid` for an index out of range, coordinates of a point outside the triangle, or a vector without three
    /// finite components.
    pub fn on_surface(
        scene: &Scene,
        id: u64,
        domain: u32,
        triangle: u32,
        barycentrics: &[f64],
        newtons: &[f64],
    ) -> Result<Self> {
        check_domain(scene, domain)?;
        let triangle_count = scene.layout.domains[domain as usize].triangles;
        if triangle as usize >= triangle_count {
            return Err(invalid("surface.triangle", format!("an index below {triangle_count}"), triangle));
        }
        let range = -BARYCENTRIC_TOLERANCE..=1.0 + BARYCENTRIC_TOLERANCE;
        let is_inside = |weights: &[f64; 3]| {
            let sum: f64 = weights.iter().sum();
            weights.iter().all(|weight| range.contains(weight)) && (sum - 1.0).abs() <= BARYCENTRIC_TOLERANCE
        };
        let Some(barycentrics) = <[f64; 3]>::try_from(barycentrics).ok().filter(is_inside) else {
            let expected = format!("three numbers of 0 to 1 with sum 1, within {BARYCENTRIC_TOLERANCE}");
            return Err(invalid("surface.barycentric", expected, describe_numbers(barycentrics)));
        };
        let is_in_range = |newtons: &[f64; 3]| newtons.iter().all(|component| component.abs() <= MAX_NEWTONS);
        let Some(newtons) = <[f64; 3]>::try_from(newtons).ok().filter(is_in_range) else {
            let expected = format!("three finite numbers of at most {MAX_NEWTONS:e} in magnitude");
            return Err(invalid("surface.vector", expected, describe_numbers(newtons)));
        };
        Ok(Self { id, domain, kind: ForceKind::Surface { triangle, barycentrics, newtons } })
    }

    /// A force on the coordinates of a domain: r little-endian f32. The fields of errors are relative to the force.
    ///
    /// # Errors
    /// `Invalid` for a domain out of range, another number of bytes or a number that is not finite.
    pub fn on_modes(scene: &Scene, id: u64, domain: u32, f_q: &[u8]) -> Result<Self> {
        check_domain(scene, domain)?;
        let rank = scene.rank_of(domain as usize);
        if f_q.len() != rank * size_of::<f32>() {
            let expected = format!("{} bytes, {rank} f32", rank * size_of::<f32>());
            return Err(invalid("modal.f_q", expected, format!("{} bytes", f_q.len())));
        }
        let f_q: Vec<f32> = bytemuck::pod_collect_to_vec(f_q);
        match f_q.iter().position(|component| !component.is_finite()) {
            None => Ok(Self { id, domain, kind: ForceKind::Modal(f_q) }),
            Some(mode) => Err(invalid("modal.f_q", "finite numbers", format!("{} at mode {mode}", f_q[mode]))),
        }
    }

    /// Whether f_q depends on the transform of the domain.
    const fn is_on_surface(&self) -> bool {
        matches!(self.kind, ForceKind::Surface { .. })
    }

    /// The point of a surface force at rest, in scene units and in the frame of the domain. `None` for a modal force.
    fn rest_point(&self, scene: &Scene) -> Option<[f64; 3]> {
        let ForceKind::Surface { triangle, barycentrics, .. } = &self.kind else { return None };
        let shape = scene.shape_of(self.domain as usize);
        let rest_position = |corner: u32| {
            let vertex = shape.mesh.corners().vertices[corner as usize];
            shape.mesh.rest_positions()[vertex as usize]
        };
        let corners = shape.mesh.triangles()[*triangle as usize].map(rest_position);
        let component = |axis: usize| {
            let terms = corners.iter().zip(barycentrics).map(|(position, weight)| weight * f64::from(position[axis]));
            shape.origin()[axis] + terms.sum::<f64>()
        };
        Some(std::array::from_fn(component))
    }

    /// The force on the coordinates of the domain: U^T A^T f at a point of the surface. A component beyond the range of
    /// f32 is the largest number, so that no reader receives infinity.
    fn reduced(&self, scene: &Scene, state: &SceneState) -> Vec<f32> {
        let (triangle, barycentrics, newtons) = match &self.kind {
            ForceKind::Modal(f_q) => return f_q.clone(),
            ForceKind::Surface { triangle, barycentrics, newtons } => (*triangle, *barycentrics, newtons),
        };
        let domain = self.domain as usize;
        let shape = scene.shape_of(domain);
        let vertex_of_corner = |corner: u32| shape.mesh.corners().vertices[corner as usize];
        let vertices = shape.mesh.triangles()[triangle as usize].map(vertex_of_corner);
        let modes = shape.modes.block_at_point(vertices, barycentrics);
        let rank = shape.modes.rank();
        let linear = state.transform_of(scene, domain).0;
        let local_force: [f64; 3] =
            std::array::from_fn(|column| (0..3).map(|row| f64::from(linear[4 * row + column]) * newtons[row]).sum());
        let component = |mode: usize| {
            let terms = (0..3).map(|row| f64::from(modes[row * rank + mode]) * local_force[row]);
            terms.sum::<f64>().clamp(f32::MIN.into(), f32::MAX.into()) as f32
        };
        (0..rank).map(component).collect()
    }
}

fn check_domain(scene: &Scene, domain: u32) -> Result<()> {
    let domain_count = scene.domains.len();
    if (domain as usize) < domain_count {
        return Ok(());
    }
    Err(invalid("domain", format!("an index below {domain_count}"), domain))
}

/// Formats numbers for an error message: all of at most four numbers, otherwise only their count.
fn describe_numbers(numbers: &[f64]) -> String {
    if numbers.len() > 4 { format!("{} numbers", numbers.len()) } else { format!("{numbers:?}") }
}

/// Identifies an owner of forces across calls. Only the client and the server know it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ForceOwner(LeaseToken);

impl ForceOwner {
    /// A token that the client has chosen.
    ///
    /// # Errors
    /// `Invalid` for a token of fewer than 16 or more than 64 bytes.
    pub fn parse(field: &str, bytes: &[u8]) -> Result<Self> {
        LeaseToken::parse(field, bytes).map(Self)
    }
}

/// All forces of one owner, and how long they last.
#[derive(Debug, Clone)]
pub struct ForceUpdate {
    pub owner: ForceOwner,
    forces: Arc<[Force]>,
    pub lifetime: Duration,
}

impl ForceUpdate {
    /// Validates the forces as a set. A lifetime of 0 means the default.
    ///
    /// # Errors
    /// `LimitReached` for too many forces; `Invalid` for a repeated id or too long a lifetime.
    pub fn new(owner: ForceOwner, forces: Vec<Force>, lifetime: Duration) -> Result<Self> {
        check_force_count(forces.len())?;
        for (index, force) in forces.iter().enumerate() {
            if forces[..index].iter().any(|earlier_force| earlier_force.id == force.id) {
                return Err(invalid(format!("forces[{index}].id"), "each id once", format!("{} again", force.id)));
            }
        }
        if lifetime > MAX_LIFETIME {
            let expected = format!("at most {} ms", MAX_LIFETIME.as_millis());
            return Err(invalid("lifetime_ms", expected, lifetime.as_millis()));
        }
        let lifetime = if lifetime.is_zero() { DEFAULT_LIFETIME } else { lifetime };
        Ok(Self { owner, forces: forces.into(), lifetime })
    }
}

/// Rejects more forces than one owner may have. Call it before the forces are parsed, which takes time.
///
/// # Errors
/// `LimitReached`.
pub fn check_force_count(count: usize) -> Result<()> {
    if count > MAX_FORCES_PER_OWNER {
        return Err(Error::LimitReached { objects: "forces of one owner", limit: MAX_FORCES_PER_OWNER });
    }
    Ok(())
}

/// The forces of one owner.
#[derive(Debug, Clone)]
struct OwnedForces {
    owner: ForceOwner,
    /// Public number of the owner, which other clients see instead of its token.
    number: u64,
    forces: Arc<[Force]>,
    expires_at: Instant,
}

/// The forces of all owners, and why nothing receives them. A clone shares the forces.
#[derive(Debug, Clone, Default)]
pub(super) struct ForceSet {
    /// The last message of the physics process that has ended; empty if none has, or if another one reads the forces.
    pub(super) receiver_error: Arc<str>,
    /// In ascending order of `number`.
    owners: Vec<OwnedForces>,
    /// `number` of the newest owner.
    last_number: u64,
}

impl ForceSet {
    /// Applies an update. Returns the number of the owner, or 0 if it has no forces now, and whether forces changed.
    fn apply(&mut self, update: &ForceUpdate, now: Instant) -> Result<(u64, bool)> {
        let has_expired = self.drop_expired(now);
        let ForceUpdate { owner, forces, lifetime } = update;
        let expires_at = now + *lifetime;
        let index = self.owners.iter().position(|owned| owned.owner == *owner);
        match index {
            None if forces.is_empty() => Ok((0, has_expired)),
            Some(index) if forces.is_empty() => {
                self.owners.remove(index);
                Ok((0, true))
            }
            Some(index) => {
                let owned = &mut self.owners[index];
                let is_changed = owned.forces != *forces;
                (owned.forces, owned.expires_at) = (Arc::clone(forces), expires_at);
                Ok((owned.number, is_changed || has_expired))
            }
            None if self.owners.len() >= MAX_OWNERS => {
                Err(Error::LimitReached { objects: "owners of forces of one scene", limit: MAX_OWNERS })
            }
            None => {
                self.last_number += 1;
                let number = self.last_number;
                self.owners.push(OwnedForces { owner: owner.clone(), number, forces: Arc::clone(forces), expires_at });
                Ok((number, true))
            }
        }
    }

    /// Returns whether forces have expired.
    fn drop_expired(&mut self, now: Instant) -> bool {
        let count = self.owners.len();
        self.owners.retain(|owned| owned.expires_at > now);
        self.owners.len() < count
    }

    /// When the next forces expire.
    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.owners.iter().map(|owned| owned.expires_at).min()
    }

    /// Whether f_q of a force depends on the state of the scene.
    pub(super) fn depends_on_state(&self) -> bool {
        self.owners.iter().flat_map(|owned| owned.forces.iter()).any(Force::is_on_surface)
    }

    /// All forces with their f_q at a state.
    pub(super) fn reduce(&self, scene: &Scene, state: &SceneState) -> Vec<AppliedForce> {
        let reduce_force = |number: u64, force: &Force| AppliedForce {
            owner: number,
            force: force.clone(),
            f_q: force.reduced(scene, state),
            rest_point: force.rest_point(scene),
        };
        let forces_of = |owned: &'_ OwnedForces| -> Vec<AppliedForce> {
            owned.forces.iter().map(|force| reduce_force(owned.number, force)).collect()
        };
        self.owners.iter().flat_map(forces_of).collect()
    }
}

/// A force, its effect on the coordinates of its domain, and its point.
#[derive(Debug, Clone, PartialEq)]
pub struct AppliedForce {
    /// Public number of the owner.
    pub owner: u64,
    pub force: Force,
    /// r numbers.
    pub f_q: Vec<f32>,
    /// The point of a surface force at rest, in scene units and in the frame of the domain. `None` for a modal force.
    pub rest_point: Option<[f64; 3]>,
}

/// The forces of a scene and the notification of their readers.
#[derive(Debug, Default)]
pub(super) struct ForceChannel {
    sets: watch::Sender<ForceSet>,
    /// Each reader that is not passive holds a clone, so the reference count is the number of these readers plus one.
    receivers: Arc<()>,
}

/// A reader of the forces of a scene, until it is dropped.
#[derive(Debug)]
pub(super) struct ForceReader {
    pub(super) sets: watch::Receiver<ForceSet>,
    _receiver: Option<Arc<()>>,
}

/// The effect of an update of forces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForceReceipt {
    /// Public number of the owner, which other clients see; 0 if the owner has no forces now.
    pub owner: u64,
    /// Number of readers that are not passive.
    pub receivers: usize,
}

impl ForceChannel {
    /// Sets the forces of an owner.
    ///
    /// # Errors
    /// `LimitReached` when too many owners have forces.
    pub(super) fn apply(&self, update: &ForceUpdate) -> Result<ForceReceipt> {
        let mut number = Ok(0);
        self.sets.send_if_modified(|set| match set.apply(update, Instant::now()) {
            Ok((owner_number, is_changed)) => {
                number = Ok(owner_number);
                is_changed
            }
            Err(error) => {
                number = Err(error);
                false
            }
        });
        Ok(ForceReceipt { owner: number?, receivers: Arc::strong_count(&self.receivers) - 1 })
    }

    /// Removes expired forces and notifies all readers if there were any.
    pub(super) fn drop_expired(&self) {
        self.sets.send_if_modified(|set| set.drop_expired(Instant::now()));
    }

    /// Reports to all readers why nothing receives the forces.
    pub(super) fn set_receiver_error(&self, message: &str) {
        self.sets.send_modify(|set| set.receiver_error = message.into());
    }

    /// Adds a reader. A passive one, which does not simulate, does not count as a receiver of the forces. Another one
    /// clears the error of the last receiver.
    ///
    /// # Errors
    /// `LimitReached` when there are too many readers.
    pub(super) fn subscribe(&self, passive: bool) -> Result<ForceReader> {
        let sets = self.sets.subscribe();
        if self.sets.receiver_count() > MAX_READERS {
            return Err(Error::LimitReached { objects: "readers of the forces of one scene", limit: MAX_READERS });
        }
        if !passive {
            self.sets.send_if_modified(|set| !std::mem::take(&mut set.receiver_error).is_empty());
        }
        Ok(ForceReader { sets, _receiver: (!passive).then(|| Arc::clone(&self.receivers)) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    fn owner(byte: u8) -> ForceOwner {
        ForceOwner::parse("owner", &[byte; 16]).expect("expected a valid token")
    }

    fn update(owner_byte: u8, domains: &[u32], lifetime_ms: u64) -> ForceUpdate {
        let scene = testing::two_strips();
        let force = |(id, domain): (usize, &u32)| {
            Force::on_surface(&scene, id as u64, *domain, 0, &[0.5, 0.25, 0.25], &[1.0, 0.0, 0.0])
        };
        let forces = domains.iter().enumerate().map(force).collect::<Result<_>>().expect("expected valid forces");
        ForceUpdate::new(owner(owner_byte), forces, Duration::from_millis(lifetime_ms))
            .expect("expected a valid update")
    }

    #[test]
    fn largest_forces_stay_finite() {
        let scene = testing::two_strips();
        let state = SceneState::rest(&scene);
        let newtons = [MAX_NEWTONS, -MAX_NEWTONS, MAX_NEWTONS];
        let force = Force::on_surface(&scene, 1, 0, 0, &[0.5, 0.25, 0.25], &newtons).expect("expected a valid force");
        assert!(force.reduced(&scene, &state).iter().all(|component| component.is_finite()));
        let mut enlarged = state;
        enlarged.transforms[0].0.iter_mut().for_each(|entry| *entry *= 1e20);
        let f_q = force.reduced(&scene, &enlarged);
        assert!(f_q.iter().all(|component| component.is_finite()), "{f_q:?}");
        assert!(f_q.iter().any(|component| component.abs() == f32::MAX), "expected the largest number: {f_q:?}");
    }

    #[test]
    fn rest_point_is_interpolated_on_the_triangle() {
        let scene = testing::two_strips();
        let force = |barycentrics: &[f64]| {
            Force::on_surface(&scene, 1, 1, 0, barycentrics, &[1.0, 0.0, 0.0]).expect("expected a valid force")
        };
        let corner = |index: usize| {
            let mut barycentrics = [0.0; 3];
            barycentrics[index] = 1.0;
            force(&barycentrics).rest_point(&scene).expect("expected a point")
        };
        let shape = scene.shape_of(1);
        let vertices = shape.mesh.triangles()[0].map(|corner| shape.mesh.corners().vertices[corner as usize]);
        let positions: Vec<[f64; 3]> = shape.exact_positions().collect();
        let corners: Vec<[f64; 3]> = (0..3).map(corner).collect();
        assert_eq!(corners, vertices.map(|vertex| positions[vertex as usize]));
        assert_ne!(corners[0], corners[1], "control");
        let point = force(&[0.5, 0.25, 0.25]).rest_point(&scene).expect("expected a point");
        for axis in 0..3 {
            let expected = 0.5 * corners[0][axis] + 0.25 * (corners[1][axis] + corners[2][axis]);
            assert!((point[axis] - expected).abs() <= 1e-12, "expected {expected}, got {point:?}");
        }
        assert_eq!(Force { id: 1, domain: 1, kind: ForceKind::Modal(vec![]) }.rest_point(&scene), None);
    }

    #[test]
    fn forces_expire_unless_they_are_renewed() {
        let (mut set, start) = (ForceSet::default(), Instant::now());
        let at = |ms: u64| start + Duration::from_millis(ms);
        assert_eq!(set.apply(&update(1, &[0], 0), at(0)), Ok((1, true)));
        assert_eq!(set.apply(&update(2, &[0, 1], 1000), at(0)), Ok((2, true)));
        assert_eq!(set.next_expiry(), Some(at(500)), "the default lifetime");
        assert_eq!(set.apply(&update(1, &[0], 0), at(499)), Ok((1, false)), "expected a renewal without a change");
        assert!(!set.drop_expired(at(998)));
        assert!(set.drop_expired(at(999)));
        assert_eq!(set.owners.iter().map(|owned| owned.number).collect::<Vec<_>>(), [2]);
        assert_eq!(set.apply(&update(1, &[0], 0), at(999)), Ok((3, true)), "expected a new number");
        assert_eq!(set.apply(&update(2, &[], 0), at(999)), Ok((0, true)));
        assert_eq!(set.apply(&update(2, &[], 0), at(999)), Ok((0, false)));
    }

    #[test]
    fn owners_are_limited_until_forces_expire() {
        let (mut set, now) = (ForceSet::default(), Instant::now());
        for byte in 0..MAX_OWNERS as u8 {
            set.apply(&update(byte, &[0], 10), now).expect("expected capacity");
        }
        let further_update = update(200, &[0], 10);
        let error = set.apply(&further_update, now).expect_err("expected a limit");
        assert_eq!(error, Error::LimitReached { objects: "owners of forces of one scene", limit: MAX_OWNERS });
        assert_eq!(set.apply(&update(0, &[1], 10), now), Ok((1, true)), "expected present owners to continue");
        assert!(set.apply(&further_update, now + Duration::from_millis(10)).is_ok());
        assert_eq!(set.owners.len(), 1);
    }

    #[test]
    fn passive_readers_are_not_counted_as_receivers() {
        let channel = ForceChannel::default();
        let receivers = || channel.apply(&update(1, &[0], 1000)).expect("expected a valid update").receivers;
        let _passive_reader = channel.subscribe(true).expect("expected capacity");
        assert_eq!(receivers(), 0);
        let readers = [(), ()].map(|()| channel.subscribe(false).expect("expected capacity"));
        assert_eq!(receivers(), 2);
        drop(readers);
        assert_eq!(receivers(), 0);
    }

    #[test]
    fn invalid_forces_are_rejected_with_their_field() {
        let scene = testing::two_strips();
        let surface = |domain: u32, triangle: u32, barycentrics: &[f64], newtons: &[f64]| {
            Force::on_surface(&scene, 0, domain, triangle, barycentrics, newtons)
        };
        let (inside, unit) = ([0.2, 0.3, 0.5], [0.0, 1.0, 0.0]);
        assert!(surface(1, 1, &[1.0004, -0.0002, 0.0005], &unit).is_ok());
        let modal = |f_q: &[f32]| Force::on_modes(&scene, 0, 0, bytemuck::cast_slice(f_q));
        assert!(modal(&[1.0, -2.0]).is_ok());
        for (force, field) in [
            (surface(2, 0, &inside, &unit), "domain"),
            (surface(0, 2, &inside, &unit), "surface.triangle"),
            (surface(0, 0, &inside[..2], &unit), "surface.barycentric"),
            (surface(0, 0, &[0.2, 0.3, 0.502], &unit), "surface.barycentric"),
            (surface(0, 0, &[3.0, -1.0, -1.0], &unit), "surface.barycentric"),
            (surface(0, 0, &[f64::NAN, 0.5, 0.5], &unit), "surface.barycentric"),
            (surface(0, 0, &inside, &[0.0, 1.0]), "surface.vector"),
            (surface(0, 0, &inside, &[0.0, f64::INFINITY, 0.0]), "surface.vector"),
            (surface(0, 0, &inside, &[0.0, f64::NAN, 0.0]), "surface.vector"),
            (modal(&[1.0]), "modal.f_q"),
            (modal(&[1.0, f32::NAN]), "modal.f_q"),
            (Force::on_modes(&scene, 0, 2, &[]), "domain"),
        ] {
            let message = force.expect_err(field).to_string();
            assert!(message.starts_with(&format!("{field}:")), "expected {field}, got {message}");
        }
    }

    #[test]
    fn repeated_ids_and_long_lifetimes_are_rejected() {
        let force = update(1, &[0], 0).forces[0].clone();
        let build = |forces: Vec<Force>, ms: u64| ForceUpdate::new(owner(1), forces, Duration::from_millis(ms));
        let error = build(vec![force.clone(); 2], 0).expect_err("expected an error").to_string();
        assert!(error.starts_with("forces[1].id"), "{error}");
        let error = build(vec![force.clone()], 10_001).expect_err("expected an error").to_string();
        assert!(error.starts_with("lifetime_ms"), "{error}");
        assert!(build(vec![force.clone()], 10_000).is_ok());
        let too_many_forces = build(vec![force; MAX_FORCES_PER_OWNER + 1], 0);
        assert!(matches!(too_many_forces, Err(Error::LimitReached { limit: MAX_FORCES_PER_OWNER, .. })));
    }

    #[test]
    fn readers_are_limited_until_one_is_dropped() {
        let channel = ForceChannel::default();
        let subscribe = |index: usize| channel.subscribe(index.is_multiple_of(2));
        let mut readers: Vec<_> = (0..MAX_READERS).map(|index| subscribe(index).expect("expected capacity")).collect();
        assert!(matches!(subscribe(0), Err(Error::LimitReached { limit: MAX_READERS, .. })));
        readers.pop();
        assert!(subscribe(0).is_ok());
    }

    #[test]
    fn unchanged_forces_notify_no_reader() {
        let channel = ForceChannel::default();
        let mut reader = channel.subscribe(false).expect("expected capacity");
        let has_changed = |reader: &mut ForceReader| {
            let has_changed = reader.sets.has_changed().expect("expected an open channel");
            reader.sets.mark_unchanged();
            has_changed
        };
        let receipt = |owner: u64| Ok(ForceReceipt { owner, receivers: 1 });
        assert_eq!(channel.apply(&update(1, &[0], 10_000)), receipt(1));
        assert!(has_changed(&mut reader));
        assert_eq!(channel.apply(&update(1, &[0], 10_000)), receipt(1));
        channel.drop_expired();
        assert!(!has_changed(&mut reader));
        assert_eq!(channel.apply(&update(1, &[], 10_000)), receipt(0));
        assert!(has_changed(&mut reader));
    }
}
