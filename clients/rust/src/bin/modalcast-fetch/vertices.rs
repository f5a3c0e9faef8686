//! Vertices to NumPy files: one row of vertices x 3 per step.

use std::time::Duration;

use modalcast_client::npy::Writer;
use modalcast_client::{Client, Error, Result, VertexRequest, VertexSet, VertexStreamRequest};

use crate::cli::VerticesOptions;
use crate::output::{Summary, bar, scene};

pub(crate) async fn fetch(client: &Client, options: &VerticesOptions, json: bool) -> Result<()> {
    let name = scene(client, &options.scene).await?;
    let mut files = Files { options, open: None, origin: vec![], summary: Summary::new() };
    match options.count {
        None => files.add(&single(client, options, &name).await?)?,
        Some(count) => stream(client, &name, count, &mut files).await?,
    }
    files.finish(json)
}

async fn single(client: &Client, options: &VerticesOptions, scene: &str) -> Result<VertexSet> {
    let mut request = VertexRequest::of(scene).within_ms(options.step.deadline_ms);
    request.domains = options.domains.clone();
    request.positions_only = options.normals.is_none();
    request = options.step.step.map_or(request.clone(), |step| request.exactly(step));
    request = options.step.min_step.map_or(request.clone(), |step| request.at_least(step));
    client.vertices(&request).await
}

async fn stream(client: &Client, scene: &str, count: u64, files: &mut Files<'_>) -> Result<()> {
    let options = files.options;
    let request = VertexStreamRequest {
        scene: scene.to_owned(),
        domains: options.domains.clone(),
        positions_only: options.normals.is_none(),
        delivery: options.delivery.into(),
        steps: count,
    };
    let mut sets = client.vertex_sets(&request).await?;
    println!("ready");
    let patience = Duration::from_secs_f64(options.timeout);
    let bar = bar(count, "steps");
    for _ in 0..count {
        let late = Error::Deadline { what: "the next step", ms: patience.as_millis() as u64 };
        let next = tokio::time::timeout(patience, sets.next()).await.map_err(|_| late)?;
        files.add(&next.unwrap_or(Err(Error::Ended { what: "the last step" }))?)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

/// The files, created when the first step says how many vertices there are.
struct Files<'a> {
    options: &'a VerticesOptions,
    open: Option<(Writer, Option<Writer>)>,
    /// That of the first step. Rows of one array have one.
    origin: Vec<f64>,
    summary: Summary,
}

impl Files<'_> {
    fn add(&mut self, set: &VertexSet) -> Result<()> {
        if self.open.is_none() {
            let positions = Writer::create(&self.options.out, &[set.positions.len() / 3, 3])?;
            let normals = self.options.normals.as_ref();
            let normals = normals.map(|path| Writer::create(path, &[set.normals.len() / 3, 3])).transpose()?;
            self.open = Some((positions, normals));
            self.origin = set.origin.clone();
        }
        if set.origin != self.origin || !set.origins.is_empty() {
            let step = set.step.number;
            let fault = format!("at step {step} positions have another origin than the rows before, or several");
            return Err(Error::file(&self.options.out, fault));
        }
        if let Some((positions, normals)) = &mut self.open {
            positions.row(&set.positions)?;
            if let Some(normals) = normals {
                normals.row(&set.normals)?;
            }
        }
        let bytes = 4 * (set.positions.len() + set.normals.len()) as u64;
        self.summary.add((set.step.run, set.step.number), bytes, set.skipped, &set.stages);
        Ok(())
    }

    fn finish(self, json: bool) -> Result<()> {
        if let Some((positions, normals)) = self.open {
            positions.finish()?;
            normals.map(Writer::finish).transpose()?;
        }
        self.summary.print("steps", &self.options.out, Some(self.origin), json);
        Ok(())
    }
}
