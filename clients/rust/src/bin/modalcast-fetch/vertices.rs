//! Saves vertices as NumPy files. Each step adds one row to every file. A row of positions has the shape vertices x 3.

use std::path::{Path, PathBuf};
use std::time::Duration;

use modalcast_client::npy::Writer as NpyWriter;
use modalcast_client::{Attribute, Client, Encoding, Error, Result};
use modalcast_client::{VertexRequest, VertexSelection, VertexSet, VertexStreamRequest};

use crate::cli::VerticesOptions;
use crate::output::{ReceivedReply, Summary, create_progress_bar, open_scene};

pub(crate) async fn fetch(client: &Client, options: &VerticesOptions, as_json: bool) -> Result<()> {
    let scene = open_scene(client, &options.scene).await?;
    let mut files = OutputFiles { options, writers: Vec::new(), origin: None, summary: Summary::new() };
    match options.count {
        None => files.write_vertex_set(&fetch_single(client, options, &scene).await?)?,
        Some(count) => fetch_stream(client, &scene, count, &mut files).await?,
    }
    files.finish(as_json)
}

async fn fetch_single(client: &Client, options: &VerticesOptions, scene: &str) -> Result<VertexSet> {
    let request = VertexRequest::new(scene, vertex_selection(options));
    let request = request.step(options.step.selector()).deadline_ms(options.step.deadline_ms);
    client.get_vertices(&request).await
}

async fn fetch_stream(client: &Client, scene: &str, count: u64, files: &mut OutputFiles<'_>) -> Result<()> {
    let options = files.options;
    let request = VertexStreamRequest::new(scene, vertex_selection(options));
    let request = request.delivery(options.delivery.into()).max_steps(count).max_hz(options.max_hz);
    let mut vertex_stream = client.stream_vertices(&request).await?;
    println!("ready");
    let timeout = Duration::from_secs_f64(options.timeout);
    let progress_bar = create_progress_bar(count, "steps");
    for _ in 0..count {
        let deadline_error = Error::Deadline { awaited_reply: "the next step", ms: timeout.as_millis() as u64 };
        let result = tokio::time::timeout(timeout, vertex_stream.next()).await.map_err(|_| deadline_error)?;
        files.write_vertex_set(&result.unwrap_or(Err(Error::StreamEnded { awaited_reply: "the last step" }))?)?;
        progress_bar.inc(1);
    }
    progress_bar.finish_and_clear();
    Ok(())
}

fn vertex_selection(options: &VerticesOptions) -> VertexSelection {
    let (vectors, normals) =
        if options.compact { (Encoding::U16Box, Encoding::OctahedralI16) } else { (Encoding::F32, Encoding::F32) };
    let attributes = [
        (true, Attribute::Positions, vectors),
        (options.normals.is_some(), Attribute::Normals, normals),
        (options.displacements.is_some(), Attribute::Displacements, vectors),
        (options.boxes.is_some(), Attribute::Boxes, Encoding::F32),
    ];
    let selected = attributes.into_iter().filter(|(is_selected, ..)| *is_selected);
    let domains = VertexSelection::default().domains(&options.domains);
    selected.fold(domains, |selection, (_, attribute, encoding)| selection.encoded_attribute(attribute, encoding))
}

/// The numbers of one array in one step: one row of its file.
struct ArrayRow<'a> {
    path: &'a Path,
    shape: Vec<usize>,
    numbers: &'a [f32],
}

/// The rows of all arrays that the options select.
fn array_rows<'a>(options: &'a VerticesOptions, set: &'a VertexSet) -> Vec<ArrayRow<'a>> {
    // Six numbers per domain: minimum x, y, z and maximum x, y, z.
    let boxes = set.boxes.as_flattened().as_flattened();
    let vector_row = |path: Option<&'a PathBuf>, numbers: &'a [f32]| {
        path.map(|path| ArrayRow { path, shape: vec![numbers.len() / 3, 3], numbers })
    };
    let rows = [
        vector_row(Some(&options.out), &set.positions),
        vector_row(options.normals.as_ref(), &set.normals),
        vector_row(options.displacements.as_ref(), &set.displacements),
        options.boxes.as_ref().map(|path| ArrayRow { path, shape: vec![boxes.len() / 6, 2, 3], numbers: boxes }),
    ];
    rows.into_iter().flatten().collect()
}

/// The output files. They are created at the first step, when the number of vertices is known.
struct OutputFiles<'a> {
    options: &'a VerticesOptions,
    /// One per array, in the order of [`array_rows`]; empty before the first step.
    writers: Vec<NpyWriter>,
    /// World position of the vertex origin of the first step, in meters. All rows of a file must have the same origin.
    origin: Option<[f64; 3]>,
    summary: Summary,
}

impl OutputFiles<'_> {
    fn write_vertex_set(&mut self, set: &VertexSet) -> Result<()> {
        let rows = array_rows(self.options, set);
        if self.writers.is_empty() {
            self.writers = rows.iter().map(|row| NpyWriter::create(row.path, &row.shape)).collect::<Result<_>>()?;
            self.origin = set.common_origin();
        }
        if self.origin.is_none() || set.common_origin() != self.origin {
            let step = set.step.number;
            let reason = format!(
                "step {step}: expected the origin of the previous steps, got a different one or one per domain"
            );
            return Err(Error::file(&self.options.out, reason));
        }
        self.writers.iter_mut().zip(&rows).try_for_each(|(writer, row)| writer.write_row(row.numbers))?;
        self.summary.add(&ReceivedReply {
            step_id: set.step,
            bytes: set.encoded_bytes,
            skipped: set.skipped,
            stages: &set.stages,
        });
        Ok(())
    }

    fn finish(self, as_json: bool) -> Result<()> {
        self.writers.into_iter().try_for_each(|writer| writer.finish().map(drop))?;
        self.summary.print("vertex_sets", &self.options.out, self.origin.map(Vec::from), as_json);
        Ok(())
    }
}
