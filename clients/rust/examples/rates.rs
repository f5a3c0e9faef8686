//! Rates of this client, for comparison with other clients: `clients/python/tools/rates.py` runs this program.
//!
//! Usage: `rates URL SCENE frames|vertices|stream COUNT`. Prints the median of COUNT times in milliseconds.
//! - `frames`: a step, its acknowledgment and a raw frame of 1280x720
//! - `vertices`: the positions of all vertices
//! - `stream`: the mean time per step of a stream of positions, while another process sends steps

use std::time::Instant;

use modalcast_client::{
    Attribute, Client, Delivery, DriveRequest, Encoding, FrameFormat, FrameRequest, Picture, Result, Step,
    VertexRequest, VertexSelection, VertexStreamRequest,
};

#[tokio::main]
async fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, scene, what, count] = arguments.as_slice() else { panic!("expected URL SCENE WHAT COUNT") };
    let count: usize = count.parse().expect("COUNT is a number");
    let client = Client::connect(url).await?;
    let mut times = match what.as_str() {
        "frames" => frame_times(&client, scene, count).await?,
        "vertices" => vertex_times(&client, scene, count).await?,
        "stream" => stream_times(&client, scene, count).await?,
        other => panic!("expected frames, vertices or stream, got {other}"),
    };
    times.sort_by(f64::total_cmp);
    println!("{:.4}", times[times.len() / 2]);
    Ok(())
}

fn positions() -> VertexSelection {
    VertexSelection::default().encoded_attribute(Attribute::Positions, Encoding::F32)
}

fn milliseconds_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

async fn frame_times(client: &Client, scene: &str, count: usize) -> Result<Vec<f64>> {
    let rank = client.describe(scene, &[]).await?.domains[0].rank;
    let mut drive = client.drive(&DriveRequest::new(scene, Delivery::Lossless)).await?;
    let picture = Picture::default().size(1280, 720).format(FrameFormat::Rgba);
    let mut times = vec![];
    for number in 0..count {
        let mut q = vec![0.0; rank];
        q[0] = number as f32 * 1e-3;
        let start = Instant::now();
        drive.step(&Step::new(number as u64, 0.0).q(0, &q)).await?;
        drive.flush().await?;
        let frame = client.render_frame(&FrameRequest::new(scene, picture)).await?;
        times.push(milliseconds_since(start));
        assert_eq!(frame.bytes.len(), 4 * 1280 * 720);
    }
    drive.finish().await?;
    Ok(times)
}

async fn vertex_times(client: &Client, scene: &str, count: usize) -> Result<Vec<f64>> {
    let mut times = vec![];
    for _ in 0..count {
        let start = Instant::now();
        let vertices = client.get_vertices(&VertexRequest::new(scene, positions())).await?;
        times.push(milliseconds_since(start));
        assert!(!vertices.positions.is_empty());
    }
    Ok(times)
}

async fn stream_times(client: &Client, scene: &str, count: usize) -> Result<Vec<f64>> {
    let mut stream = client.stream_vertices(&VertexStreamRequest::new(scene, positions())).await?;
    stream.next().await.transpose()?;
    let start = Instant::now();
    for _ in 0..count {
        let vertices = stream.next().await.transpose()?.expect("a stream without an end");
        assert!(!vertices.positions.is_empty());
    }
    Ok(vec![milliseconds_since(start) / count as f64])
}
