//! Times of this client, for comparison with other clients: `clients/python/tools/rates.py` runs this program.
//!
//! Usage: `rates URL SCENE sky|frames|vertices|stream`. Each line on standard input demands a time, which is printed in
//! milliseconds.
//! - `sky`, `frames`: a step, its acknowledgment and a raw frame of 1280x720, with a camera that sees no domain or all
//! - `vertices`: the positions of all vertices
//! - `stream`: the mean time per step of a stream of positions, while another process sends steps

use std::io::BufRead as _;
use std::time::Instant;

use modalcast_client::{
    Attribute, Camera, Client, Delivery, DriveRequest, Encoding, FrameFormat, FrameRequest, Lens, Picture, Result,
    Step, StepStream, VertexRequest, VertexSelection, VertexStreamRequest, View,
};

/// Steps of a stream per time.
const STREAM_STEPS: u32 = 50;

#[tokio::main]
async fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, scene, what] = arguments.as_slice() else { panic!("expected URL SCENE WHAT") };
    let client = Client::connect(url).await?;
    let mut stepper = match what.as_str() {
        "sky" | "frames" => Some(Stepper::open(&client, scene, what == "sky").await?),
        _ => None,
    };
    for line in std::io::stdin().lock().lines() {
        line.expect("standard input is text");
        let seconds = match &mut stepper {
            Some(stepper) => stepper.frame_time(&client, scene).await?,
            None if what == "vertices" => vertex_time(&client, scene).await?,
            None => stream_time(&client, scene).await?,
        };
        println!("{:.4}", 1e3 * seconds);
    }
    Ok(())
}

/// Sends steps, and requests a frame of each.
struct Stepper {
    drive: StepStream,
    picture: Picture,
    q: Vec<f32>,
    number: u64,
}

impl Stepper {
    async fn open(client: &Client, scene: &str, looks_up: bool) -> Result<Self> {
        let rank = client.describe(scene, &[]).await?.domains[0].rank;
        let drive = client.drive(&DriveRequest::new(scene, Delivery::Lossless)).await?;
        let view = View::LookAt { eye: [0.0, 1e3, 0.0], target: [0.0, 2e3, 0.0], up: Some([0.0, 0.0, 1.0]) };
        let camera = looks_up.then_some(Camera { view, lens: Lens::FieldOfView(45.0), clip: None });
        let picture = Picture { camera, ..Picture::default() }.size(1280, 720).format(FrameFormat::Rgb);
        Ok(Self { drive, picture, q: vec![0.0; rank], number: 0 })
    }

    async fn frame_time(&mut self, client: &Client, scene: &str) -> Result<f64> {
        self.number += 1;
        self.q[0] = self.number as f32 * 1e-3;
        let start = Instant::now();
        self.drive.step(&Step::new(self.number, 0.0).q(0, &self.q)).await?;
        self.drive.flush().await?;
        let frame = client.render_frame(&FrameRequest::new(scene, self.picture)).await?;
        let seconds = start.elapsed().as_secs_f64();
        assert_eq!(frame.bytes.len(), 3 * 1280 * 720);
        Ok(seconds)
    }
}

fn positions() -> VertexSelection {
    VertexSelection::default().encoded_attribute(Attribute::Positions, Encoding::F32)
}

async fn vertex_time(client: &Client, scene: &str) -> Result<f64> {
    let start = Instant::now();
    let vertices = client.get_vertices(&VertexRequest::new(scene, positions())).await?;
    let seconds = start.elapsed().as_secs_f64();
    assert!(!vertices.positions.is_empty());
    Ok(seconds)
}

async fn stream_time(client: &Client, scene: &str) -> Result<f64> {
    let mut stream = client.stream_vertices(&VertexStreamRequest::new(scene, positions())).await?;
    stream.next().await.transpose()?;
    let start = Instant::now();
    for _ in 0..STREAM_STEPS {
        let vertices = stream.next().await.transpose()?.expect("a stream without an end");
        assert!(!vertices.positions.is_empty());
    }
    Ok(start.elapsed().as_secs_f64() / f64::from(STREAM_STEPS))
}
