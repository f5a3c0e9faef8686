//! Forces that viewers apply to the scene while a scenario runs. A task reads the stream of forces; a run takes the
//! newest ones before each step.

use modalcast_client::{AppliedForce, Client, Error as ClientError, ForceSet};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::error::{Result, invalid_input};
use crate::loads::DomainLoads;
use crate::model::Model;

/// Largest static displacement under the forces of viewers, in diagonals of the scene's rest bounds: the sum over all
/// modes. Pulls that alternate in resonance with a mode of damping ratio 0.03 displace 21 times as much, which is still
/// below the limit of `DivergenceCheck`.
pub const MAX_STATIC_DISPLACEMENT: f64 = 0.25;

/// The factor, at most 1, by which the forces of viewers are scaled so that they do not displace the scene by more than
/// [`MAX_STATIC_DISPLACEMENT`]. `q` are the coordinates at rest under the forces. `displacements_per_unit` are those of
/// [`Model::displacements_per_unit`], or larger ones that include the domains that a mode carries.
pub fn force_scale(q: &[f64], displacements_per_unit: &[f64]) -> f64 {
    let displacement: f64 = q.iter().zip(displacements_per_unit).map(|(q, per_unit)| q.abs() * per_unit).sum();
    // Not finite if the sum overflows.
    if displacement <= MAX_STATIC_DISPLACEMENT { 1.0 } else { MAX_STATIC_DISPLACEMENT / displacement }
}

/// A remark on a factor of [`force_scale`]; `None` if the forces are not scaled.
pub fn scale_remark(scale: f64) -> Option<String> {
    (scale < 1.0).then(|| {
        format!(
            "the forces of viewers exceed what linear modes show: scaled by {scale:.3e}, so that at rest they displace the \
             scene by at most {MAX_STATIC_DISPLACEMENT} of its diagonal"
        )
    })
}

/// The forces of all viewers, read by a task that ends with this object.
pub struct ViewerForces {
    newest: watch::Receiver<ForceSet>,
    /// Returns the error that has ended the stream.
    task: JoinHandle<ClientError>,
}

impl ViewerForces {
    /// Subscribes to the forces on a scene. When this returns, the present forces have arrived.
    ///
    /// # Errors
    /// `Client` if the server rejects the subscription or the connection fails.
    pub async fn subscribe(client: &Client, scene: &str) -> Result<Self> {
        let unlimited_hz = 0.0;
        let mut stream = client.stream_forces(scene, unlimited_hz).await?;
        let ended = || ClientError::StreamEnded { awaited_reply: "the next forces" };
        let present_forces = stream.next().await.unwrap_or_else(|| Err(ended()))?;
        let (sender, mut newest) = watch::channel(present_forces);
        newest.mark_changed();
        let task = tokio::spawn(async move {
            loop {
                match stream.next().await.unwrap_or_else(|| Err(ended())) {
                    Ok(forces) => sender.send_replace(forces),
                    Err(error) => return error,
                };
            }
        });
        Ok(Self { newest, task })
    }

    /// All forces; `None` if they have not changed since the last call.
    ///
    /// # Errors
    /// `Client` if the stream has ended; `Invalid` if a force does not fit to the model or is not finite.
    pub async fn take_changed(&mut self, model: &Model) -> Result<Option<DomainLoads>> {
        match self.newest.has_changed() {
            Ok(true) => sum_forces(model, &self.newest.borrow_and_update().forces).map(Some),
            Ok(false) => Ok(None),
            // The task has dropped its sender.
            Err(_) => {
                let error = (&mut self.task).await;
                Err(error.unwrap_or(ClientError::StreamEnded { awaited_reply: "the next forces" }).into())
            }
        }
    }
}

impl Drop for ViewerForces {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The sum of forces. Domains that share coordinates add to the same numbers.
fn sum_forces(model: &Model, forces: &[AppliedForce]) -> Result<DomainLoads> {
    let mut loads = DomainLoads::none(model);
    for (index, force) in forces.iter().enumerate() {
        let domain = model.domains.get(force.domain as usize).filter(|domain| domain.rank == force.f_q.len());
        let Some(domain) = domain else {
            let given = format!("{} numbers for domain {}", force.f_q.len(), force.domain);
            return Err(invalid_input(format!("forces[{index}].f_q"), "a number per mode of a domain", given));
        };
        for (total, component) in loads.coordinates[domain.first_coordinate..].iter_mut().zip(&force.f_q) {
            *total += f64::from(*component);
        }
        if let (Some(surface), Some(rest_point)) = (&force.surface, &force.rest_point) {
            loads.add_wrench(model, force.domain as usize, &(*rest_point).into(), &surface.vector.into());
        }
    }
    let components = loads.coordinates.iter().chain(loads.wrenches.iter().flatten());
    match components.copied().find(|component| !component.is_finite()) {
        None => Ok(loads),
        Some(component) => Err(invalid_input("forces", "finite forces", component)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;
    use modalcast_client::SurfaceForce;
    use nalgebra::{Vector3, Vector6};

    fn force(domain: u32, f_q: &[f32]) -> AppliedForce {
        AppliedForce { owner: 1, id: 1, domain, surface: None, f_q: f_q.to_vec(), rest_point: None }
    }

    #[test]
    fn forces_add_up_per_coordinate() {
        // Domains 0 to 2 have two coordinates each, and domain 3 none.
        let model = four_domain_model();
        let forces = [force(1, &[1.0, 2.0]), force(0, &[4.0, 8.0]), force(1, &[0.5, 0.25]), force(3, &[])];
        let loads = sum_forces(&model, &forces).expect("valid forces");
        assert_eq!(loads.coordinates, [4.0, 8.0, 1.5, 2.25, 0.0, 0.0]);
        assert_eq!(loads.wrenches, [Vector6::zeros(); 4], "forces on coordinates have no wrench");
        assert_eq!(sum_forces(&model, &[]).expect("no forces"), DomainLoads::none(&model));
    }

    #[test]
    fn forces_on_the_surface_have_a_wrench() {
        let model = four_domain_model();
        let vector = [1.0, -2.0, 3.0];
        let surface = Some(SurfaceForce { triangle: 0, barycentric: [1.0, 0.0, 0.0], vector });
        let pull = AppliedForce { surface, rest_point: Some([0.0, 0.5, 0.0]), ..force(3, &[]) };
        let loads = sum_forces(&model, &[pull.clone(), pull]).expect("valid forces");
        let arm = model.domains[3].placement.linear * Vector3::new(0.0, 0.5, 0.0);
        let (force, moment) = crate::wrench::split(&loads.wrenches[3]);
        assert_eq!(force, 2.0 * Vector3::from(vector));
        assert!((moment - 2.0 * arm.cross(&Vector3::from(vector))).norm() <= 1e-12, "{moment}");
        assert_eq!(loads.wrenches[..3], [Vector6::zeros(); 3]);
    }

    #[test]
    fn enormous_forces_are_scaled_down() {
        let displacements_per_unit = [0.1, 0.2];
        assert_eq!(force_scale(&[0.5, -0.5], &displacements_per_unit), 1.0);
        assert_eq!(force_scale(&[10.0, -20.0], &displacements_per_unit), MAX_STATIC_DISPLACEMENT / 5.0);
        assert!(force_scale(&[f64::from(f32::MAX), 0.0], &displacements_per_unit) > 0.0);
        for overflow in [f64::MAX, f64::INFINITY] {
            assert_eq!(force_scale(&[overflow, overflow], &[10.0, 10.0]), 0.0);
        }
    }

    #[test]
    fn forces_of_another_rank_are_rejected() {
        let model = four_domain_model();
        for invalid_force in [force(0, &[1.0]), force(4, &[]), force(3, &[1.0]), force(0, &[1.0, f32::INFINITY])] {
            let error = sum_forces(&model, &[invalid_force]).expect_err("an invalid force").to_string();
            assert!(error.contains("forces"), "{error}");
        }
    }
}
