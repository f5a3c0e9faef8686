//! Synthetic scenes of known sizes, the workloads of the deformation benchmark. They are seeded, so they are identical
//! on every machine. r is the number of modes of a domain.
//!
//! | name | contents |
//! |---|---|
//! | `single-P-R` | one domain of 2^P vertices and R modes, positions only (table 4.4 of the thesis) |
//! | `a`, `a-positions` | one domain of 1.5 M vertices, r = 32, with normals and tangents, or without |
//! | `b` | 1,000 domains of 1,500 vertices, r random from 0 to 64, about 17 on average |
//! | `c` | 200,000 domains of 7 vertices, 95 % of them rigid |
//! | `cancel` | one domain of 2^16 vertices at the origin, whose modes nearly cancel in pairs |
//! | `batch` | 16 instances of one domain of 2^18 vertices, r = 32: one U for 16 vectors q (`single-18-32` has one) |
//! | `plant-1` to `plant-12` | the plants of table 4.5 |
//! | `plant-1-follows` to `plant-12-follows` | the same plants; leaves follow branches, so only branches have a T |
//!
//! `single`, `plants` and `follows` select all workloads of a group. `all` selects all workloads, but of `follows` only
//! the plant with the most domains.

mod build;
mod patch;
mod plant;

use std::sync::Arc;

use super::thesis::{PLANTS, POWERS, RANKS};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{DeformationSettings, Scene, SceneParts};

/// Maximum count of numbers in x0 and U of a load that a quick report measures at full size. Two cores measure such a
/// load in seconds.
const MAX_QUICK_NUMBERS: usize = 1 << 21;

/// Size of a workload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    Full,
    /// A fraction of the vertices or domains, for machines without a GPU. The workload's remarks state the fraction.
    Quick,
}

/// Identifies a synthetic scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkloadKind {
    /// One domain of 2^power vertices and `rank` modes.
    Single { power: u32, rank: usize },
    /// One large domain; with normals and tangents if it has a normal map.
    OneDomain { has_normal_map: bool },
    /// 1,000 domains of 1,500 vertices.
    ManyDomains,
    /// 200,000 domains of 7 vertices.
    TinyDomains,
    /// One domain whose modes nearly cancel in pairs.
    Cancelling,
    /// Instances of one shape.
    Batch,
    /// Index into [`PLANTS`].
    Plant(usize),
    /// The same plant with leaves that follow its branches.
    FollowingPlant(usize),
}

/// A scene to measure.
#[derive(Debug, Clone)]
pub struct Workload {
    pub name: String,
    pub scene: Arc<Scene>,
    /// Whether the CUDA deformer batches domains that share a U.
    pub batches: BatchPolicy,
    /// Whether modes 2k and 2k + 1 are nearly equal, so that opposite coordinates nearly cancel.
    pub has_cancelling_mode_pairs: bool,
    /// Index into [`PLANTS`], if the scene is one of the thesis's plants.
    pub thesis_plant: Option<usize>,
    /// Deviations from the size that the name states.
    pub remarks: Vec<String>,
}

impl Workload {
    /// A workload with the default batching, without cancelling mode pairs and remarks.
    pub fn new(name: String, scene: Arc<Scene>) -> Self {
        Self {
            name,
            scene,
            batches: BatchPolicy::default(),
            has_cancelling_mode_pairs: false,
            thesis_plant: None,
            remarks: Vec::new(),
        }
    }
}

impl WorkloadKind {
    /// Every workload, in the order of the report.
    pub fn all() -> Vec<Self> {
        let mut kinds = Self::singles();
        kinds.extend([
            Self::OneDomain { has_normal_map: false },
            Self::OneDomain { has_normal_map: true },
            Self::ManyDomains,
            Self::TinyDomains,
            Self::Cancelling,
            Self::Batch,
        ]);
        kinds.extend((0..PLANTS.len()).map(Self::Plant));
        let largest_plant = (0..PLANTS.len()).max_by_key(|index| PLANTS[*index].domains);
        kinds.extend(largest_plant.map(Self::FollowingPlant));
        kinds
    }

    /// All workloads of table 4.4.
    fn singles() -> Vec<Self> {
        RANKS.iter().flat_map(|rank| POWERS.map(|power| Self::Single { power, rank: *rank })).collect()
    }

    /// The workloads that a name on the command line selects.
    ///
    /// # Errors
    /// `Invalid` when there is no such workload.
    pub fn parse(name: &str) -> Result<Vec<Self>> {
        let parse_number = |text: &str| text.parse::<usize>().ok();
        let parse_plant = |number: &str| {
            parse_number(number).filter(|number| (1..=PLANTS.len()).contains(number)).map(|number| number - 1)
        };
        let kinds = match name.split('-').collect::<Vec<_>>()[..] {
            ["all"] => Some(Self::all()),
            ["single"] => Some(Self::singles()),
            ["single", power, rank] => {
                let power = parse_number(power).filter(|power| (2..=22).contains(power));
                let rank = parse_number(rank).filter(|rank| (0..=modalcast_model::domain::MAX_RANK).contains(rank));
                power.zip(rank).map(|(power, rank)| vec![Self::Single { power: power as u32, rank }])
            }
            ["a"] => Some(vec![Self::OneDomain { has_normal_map: true }]),
            ["a", "positions"] => Some(vec![Self::OneDomain { has_normal_map: false }]),
            ["b"] => Some(vec![Self::ManyDomains]),
            ["c"] => Some(vec![Self::TinyDomains]),
            ["cancel"] => Some(vec![Self::Cancelling]),
            ["batch"] => Some(vec![Self::Batch]),
            ["plants"] => Some((0..PLANTS.len()).map(Self::Plant).collect()),
            ["follows"] => Some((0..PLANTS.len()).map(Self::FollowingPlant).collect()),
            ["plant", number] => parse_plant(number).map(|index| vec![Self::Plant(index)]),
            ["plant", number, "follows"] => parse_plant(number).map(|index| vec![Self::FollowingPlant(index)]),
            _ => None,
        };
        let expected = "single-P-R (2^P vertices, P 2 to 22, R modes), a, a-positions, b, c, cancel, batch, plant-1 to \
                        plant-12, each also with -follows, or one of the groups single, plants, follows, all";
        kinds.ok_or_else(|| invalid("load", expected, name))
    }

    /// The name that [`Self::parse`] takes.
    pub fn name(self) -> String {
        match self {
            Self::Single { power, rank } => format!("single-{power}-{rank}"),
            Self::OneDomain { has_normal_map: true } => "a".into(),
            Self::OneDomain { has_normal_map: false } => "a-positions".into(),
            Self::ManyDomains => "b".into(),
            Self::TinyDomains => "c".into(),
            Self::Cancelling => "cancel".into(),
            Self::Batch => "batch".into(),
            Self::Plant(index) => format!("plant-{}", index + 1),
            Self::FollowingPlant(index) => format!("plant-{}-follows", index + 1),
        }
    }

    /// The size in a quick report: full for loads of at most `MAX_QUICK_NUMBERS` numbers in x0 and U.
    pub fn quick_size(self) -> Size {
        let numbers = match self {
            Self::Single { power, rank } => 3 * (1_usize << power) * (1 + rank),
            Self::Plant(index) | Self::FollowingPlant(index) => {
                let plant = &PLANTS[index];
                // The modes are distributed evenly over the domains that have some.
                3 * plant.vertices + plant.rows * plant.modes.div_ceil(plant.deformable.max(1))
            }
            _ => usize::MAX,
        };
        if numbers <= MAX_QUICK_NUMBERS { Size::Full } else { Size::Quick }
    }

    /// Builds the scene.
    ///
    /// # Errors
    /// Errors of [`Scene::new`]; none are expected for these sizes.
    pub fn build(self, size: Size) -> Result<Workload> {
        build::build(self, size)
    }
}

/// The scene with other deformation settings.
///
/// # Errors
/// As for [`Scene::new`].
pub fn with_deformation(scene: &Scene, deformation: DeformationSettings) -> Result<Arc<Scene>> {
    Scene::new(SceneParts { deformation, ..scene.parts() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::StorageType;

    #[test]
    fn finds_every_workload_by_name_and_rejects_others() {
        for kind in WorkloadKind::all() {
            assert_eq!(WorkloadKind::parse(&kind.name()), Ok(vec![kind]));
        }
        // Twelve plants; five powers times three ranks.
        assert_eq!(WorkloadKind::parse("plants").map(|list| list.len()), Ok(12));
        assert_eq!(WorkloadKind::parse("follows").map(|list| list.len()), Ok(12));
        assert_eq!(WorkloadKind::parse("single").map(|list| list.len()), Ok(15));
        for name in [
            "",
            "d",
            "plant-0",
            "plant-13",
            "single-23-10",
            "single-14",
            "single-14-513",
            "a-b",
            "b-",
            "plant-13-follows",
            "plant-1-",
            "b-follows",
        ] {
            assert!(WorkloadKind::parse(name).is_err(), "{name}");
        }
    }

    #[test]
    fn quick_reports_measure_small_loads_at_full_size() {
        // 3 x 2^14 x 31 = 1.5 M numbers; 3 x 2^16 x 11 = 2.2 M.
        assert_eq!(WorkloadKind::Single { power: 14, rank: 30 }.quick_size(), Size::Full);
        assert_eq!(WorkloadKind::Single { power: 16, rank: 10 }.quick_size(), Size::Quick);
        let kinds = WorkloadKind::all();
        let full = kinds.iter().filter(|kind| kind.quick_size() == Size::Full);
        let counts = full.map(|kind| {
            let scene = kind.build(Size::Full).expect("a workload").scene;
            scene.layout.domains.iter().map(|domain| 3 * domain.vertices * (1 + domain.rank)).sum::<usize>()
        });
        assert!(counts.max().is_some_and(|count| count <= 2 * MAX_QUICK_NUMBERS), "expected a small load");
    }

    #[test]
    fn building_a_workload_is_deterministic() {
        let [first_scene, second_scene] =
            [0, 1].map(|_| WorkloadKind::ManyDomains.build(Size::Quick).expect("a workload").scene);
        assert_eq!(first_scene.shapes[7].modes, second_scene.shapes[7].modes);
        assert_eq!(first_scene.shapes[7].mesh, second_scene.shapes[7].mesh);
        assert_ne!(first_scene.shapes[7].mesh, first_scene.shapes[8].mesh);
    }

    #[test]
    fn changes_only_deformation_settings_of_a_scene() {
        let scene = WorkloadKind::OneDomain { has_normal_map: true }.build(Size::Quick).expect("a workload").scene;
        let int8_scene = with_deformation(
            &scene,
            DeformationSettings { storage: StorageType::Int8, ..DeformationSettings::default() },
        )
        .expect("a valid scene");
        assert_eq!((int8_scene.deformation.storage, &int8_scene.layout), (StorageType::Int8, &scene.layout));
    }
}
