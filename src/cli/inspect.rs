//! `modalcast inspect`: prints the content of a scene, the features that it uses, and the memory and passes that are
//! saved because unused features are omitted.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Value, json};

use super::loading_options::LoadingOptions;
use super::options::{remark_lines, with_spinner};
use super::{Completion, Outcome, print_line};
use modalcast_compute::gpu::{self, CudaDeformerOptions, DeformPlan};
use modalcast_model::backend_settings::{BackendSettings, DeformTable, LookTable};
use modalcast_model::error::fault_in;
use modalcast_model::load::{self, OpenedScene};
use modalcast_model::rounding::to_significant_digits;
use modalcast_model::scene::{Scene, SceneFeatures, UpAxis};
use modalcast_render::{Pass, RenderPlan};

/// Number of domains that the text table lists; `--json` lists all.
const MAX_LISTED_DOMAINS: usize = 24;

/// Number of characters of a note that the text output shows.
const MAX_NOTE_CHARS: usize = 100;

/// Shows the size of each domain, the totals, the features that the scene needs, and the savings from unused features.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast inspect tree
  modalcast inspect part.stl --unit mm
  modalcast inspect path/to/model.glb --json")]
pub(super) struct Args {
    /// A built-in name, a folder with scene.toml, a .glb, .gltf, .obj, .ply, .stl, .npz or
    /// .structure.json file, or a folder with one model.
    scene: String,
    #[command(flatten)]
    loading: LoadingOptions,
    /// Print the description as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let opened_scene = with_spinner("loading", || load::open_with(&args.scene, &args.loading.load_options()))?;
    if args.json {
        let report = serde_json::to_value(SceneReport::new(&opened_scene)).map_err(fault_in("inspect"))?;
        print_line(serde_json::to_string_pretty(&report).map_err(fault_in("inspect"))?);
    } else {
        text_lines(&opened_scene).into_iter().for_each(print_line);
    }
    Ok(Completion::Success)
}

/// Bytes of a domain's shape in host memory: rest positions, corners, triangles, U, and the smoothing groups if the
/// normals need them.
fn shape_bytes(scene: &Scene, domain: usize) -> usize {
    let shape = scene.shape_of(domain);
    let corners = shape.mesh.corners();
    // Vertex index, normal, texture coordinates and tangent.
    let bytes_per_corner =
        4 + 12 + if corners.uvs.is_empty() { 0 } else { 8 } + if shape.tangents().is_empty() { 0 } else { 16 };
    // Three f32 per position, three u32 per triangle, and one f32 per entry of U.
    12 * shape.mesh.rest_positions().len()
        + bytes_per_corner * corners.vertices.len()
        + 12 * shape.mesh.triangles().len()
        + 4 * shape.modes.columns().len()
        + shape.smoothing().map_or(0, |smoothing| smoothing.bytes() as usize)
}

/// The JSON output. A struct cannot contain a key twice, whereas `json!` would accept it.
#[derive(Serialize)]
struct SceneReport<'a> {
    scene: &'a str,
    up: UpAxis,
    #[serde(rename = "unit_metres")]
    unit: f64,
    origin: [f64; 3],
    totals: Value,
    #[serde(rename = "needs")]
    features: SceneFeatures,
    look: LookTable,
    /// The settings in the `deform` table of `scene.toml`.
    deformation: DeformTable,
    remarks: &'a [String],
    /// The files of the modes, as in the text output.
    modes: Vec<String>,
    /// The plan of the deformer.
    deform: DeformPlan,
    /// The plan of the renderer.
    render: RenderPlan,
    domains: Vec<DomainReport<'a>>,
}

/// One domain in the JSON output.
#[derive(Serialize)]
struct DomainReport<'a> {
    name: &'a str,
    vertices: usize,
    rank: usize,
    triangles: usize,
    corners: usize,
    /// Host memory of the domain's shape.
    bytes: usize,
    shape: usize,
    /// Index of the parent domain at the joint of this domain. The server does not move a child with its parent.
    parent: Option<usize>,
    /// Index of the domain whose transform determines the transform of this domain.
    follows: Option<usize>,
    material: &'a str,
    notes: &'a BTreeMap<String, String>,
}

impl<'a> SceneReport<'a> {
    fn new(OpenedScene { scene, backends }: &'a OpenedScene) -> Self {
        Self {
            scene: &scene.name,
            up: scene.up,
            unit: scene.unit,
            origin: scene.origin,
            totals: totals(scene),
            features: scene.features,
            look: LookTable { settings: scene.look, raster: backends.raster },
            deformation: DeformTable { settings: scene.deformation, batches: backends.batches },
            remarks: &scene.remarks,
            modes: load::modes_files(scene),
            deform: deform_plan(scene, backends),
            render: modalcast_render::plan(scene),
            domains: (0..scene.domains.len()).map(|index| DomainReport::new(scene, index)).collect(),
        }
    }
}

impl<'a> DomainReport<'a> {
    fn new(scene: &'a Scene, index: usize) -> Self {
        let (domain, domain_layout) = (&scene.domains[index], scene.layout.domains[index]);
        Self {
            name: &domain.name,
            vertices: domain_layout.vertices,
            rank: domain_layout.rank,
            triangles: domain_layout.triangles,
            corners: domain_layout.corners,
            bytes: shape_bytes(scene, index),
            shape: domain.shape,
            parent: domain.attachment.as_ref().map(|attachment| attachment.parent),
            follows: domain.follows.map(|follow| follow.parent),
            material: &scene.materials[domain.material].name,
            notes: &domain.metadata.notes,
        }
    }
}

fn totals(scene: &Scene) -> Value {
    // Instances share a shape, so each shape is counted once.
    let mut is_counted = vec![false; scene.shapes.len()];
    let mut bytes = 0;
    for (index, domain) in scene.domains.iter().enumerate() {
        if !is_counted[domain.shape] {
            is_counted[domain.shape] = true;
            bytes += shape_bytes(scene, index);
        }
    }
    json!({
        "domains": scene.domains.len(),
        "shapes": scene.shapes.len(),
        "vertices": scene.layout.vertices,
        "corners": scene.layout.corners,
        "triangles": scene.layout.triangles,
        "coordinates": scene.layout.coordinates,
        "textures": scene.textures.len(),
        "shape_bytes": bytes,
    })
}

fn text_lines(opened_scene: &OpenedScene) -> Vec<String> {
    let scene = &opened_scene.scene;
    let mut lines = vec![format!("{:<28}{:>10}{:>6}{:>12}{:>14}", "domain", "vertices", "r", "triangles", "bytes")];
    for (index, domain) in scene.domains.iter().enumerate().take(MAX_LISTED_DOMAINS) {
        let domain_layout = scene.layout.domains[index];
        let bytes = shape_bytes(scene, index);
        lines.push(format!(
            "{:<28}{:>10}{:>6}{:>12}{:>14}",
            domain.name, domain_layout.vertices, domain_layout.rank, domain_layout.triangles, bytes
        ));
    }
    if scene.domains.len() > MAX_LISTED_DOMAINS {
        lines.push(format!("... and {} more (--json lists all)", scene.domains.len() - MAX_LISTED_DOMAINS));
    }
    let totals = totals(scene);
    let entries = totals.as_object().into_iter().flatten();
    lines.extend(entries.map(|(name, value)| format!("{:<28}{value:>16}", format!("total {name}"))));
    let diagonal = scene.rest_bounds.diagonal();
    lines.push(format!(
        "up {:?}, unit {} m, diagonal {}, origin {:?}",
        scene.up,
        scene.unit,
        to_significant_digits(diagonal, 4),
        scene.origin
    ));
    lines.extend(load::modes_files(scene).iter().map(|file| format!("modes: {file}")));
    if let [domain] = &scene.domains[..] {
        lines.extend(domain.metadata.notes.iter().map(|(name, text)| format!("note {name}: {}", shortened(text))));
    }
    lines.extend(remark_lines(scene));
    let flags = scene.features.flags().into_iter();
    let needed_features: Vec<&str> = flags.filter_map(|(name, is_needed)| is_needed.then_some(name)).collect();
    lines.push(format!("needs: {}", needed_features.join(", ")));
    lines.extend(plan_lines(opened_scene));
    lines
}

/// The text of a note, or its beginning if it is long (`--json` has all of it).
fn shortened(text: &str) -> String {
    match text.char_indices().nth(MAX_NOTE_CHARS) {
        Some((end, _)) => format!("{} ...", &text[..end]),
        None => text.to_owned(),
    }
}

/// The plan of the CUDA deformer that the server creates for the scene.
fn deform_plan(scene: &Scene, backends: &BackendSettings) -> DeformPlan {
    gpu::plan(scene, CudaDeformerOptions { batches: backends.batches, bounding_axes: scene.light_axes() })
}

fn pass_names(passes: &[Pass]) -> Vec<&str> {
    passes.iter().map(|pass| pass.name()).collect()
}

/// The kernels, passes and memory that the deformer and the renderer plan for the scene, and the parts that they omit.
fn plan_lines(OpenedScene { scene, backends }: &OpenedScene) -> Vec<String> {
    let (deform, render) = (deform_plan(scene, backends), modalcast_render::plan(scene));
    let kernels: Vec<String> =
        deform.kernels.iter().map(|kernel| format!("{} [{}]", kernel.name, kernel.defines.join(" "))).collect();
    let mut lines = vec![
        format!("kernels: {}; {} launches a step", kernels.join(", "), deform.launches()),
        format!(
            "passes: {}; {} draw calls; shaders [{}]",
            pass_names(&render.passes).join(", "),
            render.draw_calls,
            render.defines.join(" ")
        ),
        format!("device memory: {} bytes to deform, {} to render", deform.total_bytes(), render.bytes()),
    ];
    for part in &deform.omitted {
        lines.push(format!("omitted from deforming, {}: {}; saves {} bytes", part.feature, part.what, part.bytes));
    }
    for part in &render.omitted {
        let passes = if part.passes.is_empty() { "no pass".into() } else { pass_names(&part.passes).join(" and ") };
        lines.push(format!(
            "omitted from rendering, {}: {}; saves {} bytes and {passes}",
            part.feature, part.shaders, part.bytes
        ));
    }
    lines
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};

    use super::*;

    /// Any JSON value. Its deserialization fails if an object contains a key twice.
    struct UniqueKeys;

    impl<'de> Deserialize<'de> for UniqueKeys {
        fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
            deserializer.deserialize_any(Self)
        }
    }

    impl<'de> Visitor<'de> for UniqueKeys {
        type Value = Self;

        fn expecting(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            out.write_str("a JSON value with unique keys")
        }

        fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self, A::Error> {
            let mut keys = BTreeSet::new();
            while let Some((key, Self)) = map.next_entry::<String, Self>()? {
                if !keys.insert(key.clone()) {
                    return Err(A::Error::custom(format!("expected unique keys, got '{key}' twice")));
                }
            }
            Ok(self)
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self, A::Error> {
            while list.next_element::<Self>()?.is_some() {}
            Ok(self)
        }

        fn visit_str<E>(self, _: &str) -> Result<Self, E> {
            Ok(self)
        }

        fn visit_f64<E>(self, _: f64) -> Result<Self, E> {
            Ok(self)
        }

        fn visit_u64<E>(self, _: u64) -> Result<Self, E> {
            Ok(self)
        }

        fn visit_i64<E>(self, _: i64) -> Result<Self, E> {
            Ok(self)
        }

        fn visit_bool<E>(self, _: bool) -> Result<Self, E> {
            Ok(self)
        }

        fn visit_unit<E>(self) -> Result<Self, E> {
            Ok(self)
        }
    }

    #[test]
    fn modes_are_named_with_their_rank() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a written file");
        write("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
        write("a.modes.txt", "9 1\n0 0 0 0 0 0 0 0 1\n");
        write("pressure.npy", "");
        let opened_scene = load::open(&folder.path().to_string_lossy()).expect("expected a scene");
        let lines = text_lines(&opened_scene);
        assert!(lines.contains(&"modes: a.modes.txt (r = 1)".to_owned()), "{lines:?}");
        assert!(lines.contains(&"remark: not used as modes: pressure.npy".to_owned()), "{lines:?}");
        assert!(lines.contains(&"note modes.file: a.modes.txt".to_owned()), "{lines:?}");
        assert_eq!(shortened(&"ä".repeat(101)), format!("{} ...", "ä".repeat(100)));
        assert_eq!(shortened(&"ä".repeat(100)), "ä".repeat(100));
    }

    #[test]
    fn json_has_each_key_once_and_the_deform_settings() {
        let opened_scene = load::open("tree").expect("expected the built-in scene");
        let text = serde_json::to_string(&SceneReport::new(&opened_scene)).expect("expected a serialized report");
        serde_json::from_str::<UniqueKeys>(&text).map(drop).expect("expected unique keys");
        assert!(
            serde_json::from_str::<UniqueKeys>(r#"[{"a": {"b": 1, "b": null}}]"#).is_err(),
            "negative control: expected an error for the repeated key 'b'"
        );
        let value: Value = serde_json::from_str(&text).expect("expected JSON");
        assert!(value["deformation"]["storage"].is_string(), "{}", value["deformation"]);
        assert_eq!(value["deformation"]["batches"], "auto");
        assert!(value["deform"]["kernels"].is_array() && value["render"]["passes"].is_array(), "{text}");
    }
}
