//! Displacements of a scene at rest under forces at vertices.

use modalcast_client::{Client, Shape, ShapeArray};
use nalgebra::Vector3;
use serde_json::{Value, json};

use crate::coupled::{StaticResponse, StaticSystem};
use crate::error::{Result, invalid_input};
use crate::loads::DomainLoads;
use crate::model::{Model, Sample};
use crate::parameters::ModalParameters;
use crate::run::Report;

/// A vertex of a domain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VertexName {
    /// Name or index of the domain.
    pub domain: String,
    pub vertex: u32,
}

/// A force at a vertex.
#[derive(Debug, Clone, PartialEq)]
pub struct VertexForce {
    pub vertex: VertexName,
    /// In newtons and world axes.
    pub force: [f64; 3],
}

/// A vertex with its domain and its rows of U.
struct Point {
    domain: usize,
    vertex: u32,
    sample: Sample,
}

/// Computes the displacements under all forces together: of every vertex with a force, of the vertices `at`, and of the
/// domains that carry the vertices. Displacements are in world axes and scene units.
///
/// # Errors
/// `Client` if a request fails; `Invalid` if a domain or a vertex does not exist, if a force cannot move the scene, or
/// as for [`StaticSystem::new`].
pub async fn report_deflections(
    client: &Client,
    model: &Model,
    forces: &[VertexForce],
    at: &[VertexName],
) -> Result<Report> {
    let system = StaticSystem::new(model, &ModalParameters::read(model)?)?;
    let names: Vec<&VertexName> = forces.iter().map(|force| &force.vertex).chain(at).collect();
    let points = fetch_points(client, model, &names).await?;
    let mut loads = DomainLoads::none(model);
    for (force, point) in forces.iter().zip(&points) {
        loads.add_force(model, point.domain, &point.sample, &Vector3::from(force.force));
    }
    let response = system.solve(&loads);
    let describe_force = |(force, point): (&VertexForce, &Point)| {
        let mut description = describe_point(model, &response, point);
        description["force_n"] = json!(force.force);
        description
    };
    let described_forces: Vec<Value> = forces.iter().zip(&points).map(describe_force).collect();
    let described_points: Vec<Value> =
        points[forces.len()..].iter().map(|point| describe_point(model, &response, point)).collect();
    Ok(Report::from_iter([
        ("scene".to_owned(), json!(model.scene)),
        ("forces".to_owned(), json!(described_forces)),
        ("at".to_owned(), json!(described_points)),
    ]))
}

/// The displacement of a point, and the motions of its domain and of the domains that carry it, from the root on.
fn describe_point(model: &Model, response: &StaticResponse, point: &Point) -> Value {
    let mut path = vec![point.domain];
    // A domain moves with an earlier one, so this ends.
    while let Some(carrier) = model.domains[path[path.len() - 1]].carrier() {
        path.push(carrier);
    }
    let describe_domain = |index: &usize| {
        let samples = model.domains[*index].samples.iter();
        let displacements = samples.map(|sample| response.displacement(model, *index, sample).norm());
        json!({
            "domain": model.domains[*index].name,
            "origin_displacement": response.translation(*index).as_slice(),
            "rotation_radians": response.rotation(*index).as_slice(),
            "largest_displacement": displacements.fold(0.0, f64::max),
        })
    };
    let displacement = response.displacement(model, point.domain, &point.sample);
    json!({
        "domain": model.domains[point.domain].name,
        "vertex": point.vertex,
        "displacement": displacement.as_slice(),
        "path": path.iter().rev().map(describe_domain).collect::<Vec<Value>>(),
    })
}

/// Reads the vertices with their rows of U.
async fn fetch_points(client: &Client, model: &Model, names: &[&VertexName]) -> Result<Vec<Point>> {
    let arrays = [ShapeArray::RestPositions];
    let description = client.describe(&model.scene, &arrays).await?;
    let has_origins = description.shapes.iter().any(Shape::has_origin);
    let description = match has_origins {
        true => client.describe(&model.scene, &[ShapeArray::RestPositions, ShapeArray::CenteredPositions]).await?,
        false => description,
    };
    let mut points = vec![];
    for name in names {
        let domain = find_domain(model, &name.domain)?;
        let shape = description.shape_of(&description.domains[domain]);
        if name.vertex as usize >= shape.vertex_count {
            let field = format!("vertex of '{}'", model.domains[domain].name);
            return Err(invalid_input(field, format!("an index below {}", shape.vertex_count), name.vertex));
        }
        let rows = client.read_modes(&model.scene, domain, &[name.vertex]).await?.rows;
        if rows.len() != 3 * model.domains[domain].rank {
            let field = format!("rows of U of '{}'", model.domains[domain].name);
            return Err(invalid_input(field, 3 * model.domains[domain].rank, rows.len()));
        }
        let mode_rows = rows.into_iter().map(f64::from).collect();
        let sample = Sample { rest_position: crate::model::rest_position(shape, name.vertex), mode_rows, part: 0 };
        points.push(Point { domain, vertex: name.vertex, sample });
    }
    Ok(points)
}

/// The index of the first domain with a name, or of the domain with this index if no domain has the name.
fn find_domain(model: &Model, name: &str) -> Result<usize> {
    let named = model.domains.iter().position(|domain| domain.name == name);
    let indexed = || name.parse().ok().filter(|index| *index < model.domains.len());
    named.or_else(indexed).ok_or_else(|| {
        let expected = format!("the name of a domain, or an index below {}", model.domains.len());
        invalid_input("domain", expected, format!("'{name}'"))
    })
}
