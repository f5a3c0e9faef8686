//! Saves vertices as NumPy files, with one row of vertices x 3 per step.

use std::path::{Path, PathBuf};
use std::time::Duration;

use modalcast_client::npy::Writer;
use modalcast_client::{Client, Error, Result, VertexRequest, VertexSelection, VertexSet, VertexStreamRequest};

use crate::cli::VerticesOptions;
use crate::output::{ReceivedStep, Summary, bar, scene};

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
    let request = VertexRequest::new(scene, selection(options));
    let request = request.at(options.step.selector()).deadline_ms(options.step.deadline_ms);
    client.vertices(&request).await
}

async fn stream(client: &Client, scene: &str, count: u64, files: &mut Files<'_>) -> Result<()> {
    let options = files.options;
    let request = VertexStreamRequest::new(scene, selection(options));
    let request = request.delivery(options.delivery.into()).replies(count);
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

fn selection(options: &VerticesOptions) -> VertexSelection {
    VertexSelection {
        domains: options.domains.clone(),
        positions_only: options.normals.is_none(),
        displacements: options.displacements.is_some(),
        boxes: options.boxes.is_some(),
        without_vertices: false,
    }
}

/// One step of an array that is saved.
struct ArrayRow<'a> {
    file: &'a Path,
    shape: Vec<usize>,
    numbers: &'a [f32],
}

fn array_rows<'a>(options: &'a VerticesOptions, set: &'a VertexSet) -> Vec<ArrayRow<'a>> {
    let boxes = set.boxes.as_flattened().as_flattened();
    let triples = |file: Option<&'a PathBuf>, numbers: &'a [f32]| {
        file.map(|file| ArrayRow { file, shape: vec![numbers.len() / 3, 3], numbers })
    };
    let all = [
        triples(Some(&options.out), &set.positions),
        triples(options.normals.as_ref(), &set.normals),
        triples(options.displacements.as_ref(), &set.displacements),
        options.boxes.as_ref().map(|file| ArrayRow { file, shape: vec![boxes.len() / 6, 2, 3], numbers: boxes }),
    ];
    all.into_iter().flatten().collect()
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
        let rows = array_rows(self.options, set);
        if self.open.is_empty() {
            self.open = rows.iter().map(|row| Writer::create(row.file, &row.shape)).collect::<Result<_>>()?;
            self.origin = set.origin.clone();
        }
        if set.origin != self.origin || !set.origins.is_empty() {
            let step = set.step.number;
            let fault = format!("step {step}: expected the origin of the rows before, got another one or several");
            return Err(Error::file(&self.options.out, fault));
        }
        self.open.iter_mut().zip(&rows).try_for_each(|(file, row)| file.row(row.numbers))?;
        let bytes = rows.iter().map(|row| size_of_val(row.numbers) as u64).sum();
        self.summary.add(&ReceivedStep { step: set.step, bytes, skipped: set.skipped, stages: &set.stages });
        Ok(())
    }

    fn finish(self, json: bool) -> Result<()> {
        self.open.into_iter().try_for_each(|file| file.finish().map(drop))?;
        self.summary.print("steps", &self.options.out, Some(self.origin), json);
        Ok(())
    }
}
