//! Saves vertices as NumPy files, with one row of vertices x 3 per step.

use std::path::Path;
use std::time::Duration;

use modalcast_client::npy::Writer;
use modalcast_client::{Client, Error, ReadbackOptions, Result, VertexRequest, VertexSet, VertexStreamRequest};

use crate::cli::VerticesOptions;
use crate::output::{Summary, bar, scene};

pub(crate) async fn fetch(client: &Client, options: &VerticesOptions, json: bool) -> Result<()> {
    let name = scene(client, &options.scene).await?;
    let mut files = Files { options, open: Vec::new(), origin: vec![], summary: Summary::new() };
    match options.count {
        None => files.add(&single(client, options, &name).await?)?,
        Some(count) => stream(client, &name, count, &mut files).await?,
    }
    files.finish(json)
}

async fn single(client: &Client, options: &VerticesOptions, scene: &str) -> Result<VertexSet> {
    let mut request = VertexRequest::new(scene).deadline_ms(options.step.deadline_ms);
    request.domains = options.domains.clone();
    request.positions_only = options.normals.is_none();
    request.readback = readback(options);
    request = options.step.step.map_or(request.clone(), |step| request.exact_step(step));
    request = options.step.min_step.map_or(request.clone(), |step| request.minimum_step(step));
    client.vertices(&request).await
}

async fn stream(client: &Client, scene: &str, count: u64, files: &mut Files<'_>) -> Result<()> {
    let options = files.options;
    let request = VertexStreamRequest {
        scene: scene.to_owned(),
        domains: options.domains.clone(),
        positions_only: options.normals.is_none(),
        readback: readback(options),
        delivery: options.delivery.into(),
        steps: count,
    };
    let mut sets = client.stream_vertices(&request).await?;
    println!("ready");
    let timeout = Duration::from_secs_f64(options.timeout);
    let bar = bar(count, "steps");
    for _ in 0..count {
        let late = Error::Deadline { what: "the next step", ms: timeout.as_millis() as u64 };
        let next = tokio::time::timeout(timeout, sets.next()).await.map_err(|_| late)?;
        files.add(&next.unwrap_or(Err(Error::StreamEnded { what: "the last step" }))?)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

fn readback(options: &VerticesOptions) -> ReadbackOptions {
    let (displacements, boxes) = (options.displacements.is_some(), options.boxes.is_some());
    ReadbackOptions { displacements, boxes, without_vertices: false }
}

/// The file of one array, the shape of its rows, and the row of one step.
type Array<'a> = (&'a Path, Vec<usize>, &'a [f32]);

fn arrays<'a>(options: &'a VerticesOptions, set: &'a VertexSet) -> Vec<Array<'a>> {
    let triples = |numbers: &'a [f32]| (vec![numbers.len() / 3, 3], numbers);
    let boxes = set.boxes.as_flattened().as_flattened();
    let all = [
        (Some(&options.out), triples(&set.positions)),
        (options.normals.as_ref(), triples(&set.normals)),
        (options.displacements.as_ref(), triples(&set.displacements)),
        (options.boxes.as_ref(), (vec![boxes.len() / 6, 2, 3], boxes)),
    ];
    let named = all.into_iter().filter_map(|(path, (shape, row))| Some((path?.as_path(), shape, row)));
    named.collect()
}

/// The output files. They are created with the first step, which has the number of vertices.
struct Files<'a> {
    options: &'a VerticesOptions,
    open: Vec<Writer>,
    /// The origin of the first step. All rows of one array must have the same origin.
    origin: Vec<f64>,
    summary: Summary,
}

impl Files<'_> {
    fn add(&mut self, set: &VertexSet) -> Result<()> {
        let arrays = arrays(self.options, set);
        if self.open.is_empty() {
            let create = |(path, shape, _): &Array<'_>| Writer::create(path, shape);
            self.open = arrays.iter().map(create).collect::<Result<_>>()?;
            self.origin = set.origin.clone();
        }
        if set.origin != self.origin || !set.origins.is_empty() {
            let step = set.step.number;
            let fault = format!("at step {step} positions have another origin than the rows before, or several");
            return Err(Error::file(&self.options.out, fault));
        }
        let rows = arrays.iter().map(|(_, _, row)| *row);
        self.open.iter_mut().zip(rows).try_for_each(|(file, row)| file.row(row))?;
        let bytes = arrays.iter().map(|(_, _, row)| size_of_val(*row) as u64).sum();
        self.summary.add((set.step.run, set.step.number), bytes, set.skipped, &set.stages);
        Ok(())
    }

    fn finish(self, json: bool) -> Result<()> {
        self.open.into_iter().try_for_each(|file| file.finish().map(drop))?;
        self.summary.print("steps", &self.options.out, Some(self.origin), json);
        Ok(())
    }
}
