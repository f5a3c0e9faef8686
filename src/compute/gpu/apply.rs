//! Launches `kernels/apply.cu`, which reads new transforms and coordinates of changed domains directly from pinned
//! memory.

use cudarc::driver::{CudaFunction, LaunchConfig, PinnedHostSlice, PushKernelArg as _, sys};

use super::deform::config;
use super::device::Device;
use super::inputs::{InputAddresses, InputPacker};
use super::layout::{ApplyArgs, Change};
use super::plan::KernelDescriptor;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Scene, SceneState};

/// A partial step pays off up to 1 / `MAX_CHANGED_DIVISOR` of the domains; beyond that the whole state is copied.
const MAX_CHANGED_DIVISOR: usize = 4;

/// The kernel, and the writer of the lists that it reads over the bus.
#[derive(Debug)]
pub struct ApplyKernel {
    function: CudaFunction,
    config: LaunchConfig,
    /// Maximum number of entries.
    most: usize,
    coordinates: usize,
    /// Per tile, the number of the last list that contains it; and the number of lists written.
    named: Vec<u32>,
    lists: u32,
}

/// Pinned memory for the lists of one step: `[changes][transforms][q][tiles]`.
pub(super) type ChangeListBuffer = PinnedHostSlice<u32>;

/// Lengths of the lists of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChangeListLengths {
    pub changed: u32,
    pub dirty_tiles: u32,
}

/// Words of a [`Change`] and of a transform.
const CHANGE_WORDS: usize = size_of::<Change>() / 4;
const TRANSFORM_WORDS: usize = 12;

/// Maximum number of changed domains in a partial step; 0 where steps are always full: when the scene has too few
/// domains, or when it truncates modes. The set of truncated modes depends on q and is uploaded only with the whole
/// state.
pub(super) const fn max_changed_domains(scene: &Scene) -> usize {
    if scene.needs.truncation { 0 } else { scene.domains.len() / MAX_CHANGED_DIVISOR }
}

/// Maximum number of entries of such a list: silent domains have none.
pub(super) fn max_change_entries(scene: &Scene) -> usize {
    let silent = (0..scene.domains.len()).filter(|domain| needs_no_entry(scene, *domain)).count();
    max_changed_domains(scene).min(scene.domains.len() - silent)
}

/// Whether a step never has to send a change of this domain: the domain follows another domain's transform, has no
/// coordinates, and the scene keeps neither exact normals nor boxes, which read the step of its last change. Its tiles
/// are recomputed nevertheless.
fn needs_no_entry(scene: &Scene, domain: usize) -> bool {
    let needs = scene.needs;
    needs.followers
        && !(needs.exact_normals || needs.boxes)
        && scene.layout.slots[domain].rank == 0
        && scene.movers.frame_of(domain).is_some()
}

impl ApplyKernel {
    pub fn new(device: &Device, packing: &InputPacker, kernel: &KernelDescriptor) -> Result<Self> {
        let function = device.function(kernel.name, kernel.source.0, &kernel.defines)?;
        Ok(Self {
            function,
            config: config(kernel),
            most: max_change_entries(&packing.scene),
            coordinates: packing.coordinates.total,
            named: vec![0; packing.dirty_tile_layout.tiles],
            lists: 0,
        })
    }

    /// Allocates pinned memory for the lists of a step.
    pub fn list(&self, device: &Device) -> Result<ChangeListBuffer> {
        let words = (CHANGE_WORDS + TRANSFORM_WORDS) * self.most + self.coordinates + self.named.len();
        let flags = sys::CU_MEMHOSTALLOC_WRITECOMBINED | sys::CU_MEMHOSTALLOC_DEVICEMAP;
        // SAFETY: the memory is uninitialized; the kernel reads only what `write` wrote.
        unsafe { device.context().alloc_pinned_with_flags(words, flags) }.map_err(fault_in("allocate"))
    }

    /// Writes the lists of a partial step. `changed`: domains that the step changes. `dirty_domains`: further domains that the
    /// output lacks. The caller has waited for the last launch with `list`. Returns `None` when the lists have no
    /// capacity for the changes, or when a full step is less work.
    pub fn write(
        &mut self,
        list: &mut ChangeListBuffer,
        packing: &InputPacker,
        state: &SceneState,
        (changed, dirty_domains): (&[u32], &[u32]),
    ) -> Result<Option<ChangeListLengths>> {
        let scene = &packing.scene;
        if changed.len() > max_changed_domains(scene) {
            return Ok(None);
        }
        let words = list.as_mut_slice().map_err(fault_in("upload"))?;
        let (changes, rest) = words.split_at_mut(CHANGE_WORDS * self.most);
        let (transforms, rest) = rest.split_at_mut(TRANSFORM_WORDS * self.most);
        let (q, tiles) = rest.split_at_mut(self.coordinates);
        let (mut source, mut count) = (0, 0);
        let told = changed.iter().filter(|domain| !needs_no_entry(scene, **domain as usize));
        for (index, domain) in told.enumerate() {
            let (at, first) = (*domain as usize, source);
            // The kernel does not read the transform of a follower.
            let transform: [u32; TRANSFORM_WORDS] = bytemuck::cast(state.transforms[scene.movers.of(at)].0);
            transforms[TRANSFORM_WORDS * index..][..TRANSFORM_WORDS].copy_from_slice(&transform);
            let own = state.q_of(scene, at);
            if source + own.len().next_multiple_of(4) > self.coordinates {
                // Domains can share coordinates, so the entries may need more coordinates than the scene has.
                return Ok(None);
            }
            packing.put_q(at, own, |number| {
                q[source] = number.to_bits();
                source += 1;
            });
            let change = Change {
                domain: *domain,
                first_q: packing.coordinates.first[at],
                count: (source - first) as u32,
                source: first as u32,
            };
            changes[CHANGE_WORDS * index..][..CHANGE_WORDS].copy_from_slice(bytemuck::cast_slice(&[change]));
            count += 1;
        }
        if self.lists == u32::MAX {
            self.named.fill(0);
            self.lists = 0;
        }
        self.lists += 1;
        // The values and stamps of the domains in `dirty_domains` are already on the device.
        let lacking = changed.iter().chain(dirty_domains);
        let dirty_tiles = list_tiles(packing, lacking, (&mut self.named, self.lists), tiles);
        if dirty_tiles as usize > packing.dirty_tile_layout.whole {
            return Ok(None);
        }
        Ok(Some(ChangeListLengths { changed: count, dirty_tiles }))
    }

    /// Starts the kernel. The header among `values` has the lengths of the lists. The kernel copies the tile list to
    /// `tiles`.
    pub fn launch(
        &self,
        device: &Device,
        list: &mut ChangeListBuffer,
        values: InputAddresses,
        tiles: u64,
    ) -> Result<()> {
        let fail = fault_in("apply");
        let list = list.as_mut_ptr().map_err(&fail)? as u64;
        let new_transforms = list + 4 * (CHANGE_WORDS * self.most) as u64;
        let new_q = new_transforms + 4 * (TRANSFORM_WORDS * self.most) as u64;
        let args = ApplyArgs {
            header: values.header,
            changes: list,
            new_transforms,
            new_q,
            dirty_tiles: new_q + 4 * self.coordinates as u64,
            transform_links: values.transform_links,
            transforms: values.transforms,
            q: values.q,
            change_steps: values.change_steps,
            list: tiles,
        };
        let mut launch = device.stream().launch_builder(&self.function);
        // SAFETY: `ApplyArgs` is the kernel's only argument. Pinned memory has the same address on host and device
        // (unified addressing), and the list refers to domains and coordinates of the scene that the buffers were made
        // for.
        unsafe { launch.arg(&args).launch(self.config) }.map_err(fail)?;
        Ok(())
    }
}

/// Lists the tiles of these domains, each once. Returns their number.
fn list_tiles<'a>(
    packing: &InputPacker,
    domains: impl Iterator<Item = &'a u32>,
    (named, list): (&mut [u32], u32),
    tiles: &mut [u32],
) -> u32 {
    let mut count = 0;
    for domain in domains {
        for (first, length) in packing.dirty_tile_layout.spans[*domain as usize] {
            for tile in first..first + length {
                let mark = &mut named[tile as usize];
                if *mark != list {
                    *mark = list;
                    tiles[count] = tile;
                    count += 1;
                }
            }
        }
    }
    count as u32
}

#[cfg(test)]
mod tests {
    use super::super::normal_tables::tests::{deformed, followed};
    use super::*;
    use modalcast_model::scene::{DeformationSettings, NormalMethod};

    #[test]
    fn followers_without_coordinates_have_entries_where_somebody_asks_for_their_stamps_alone() {
        let plain = DeformationSettings::default();
        let exact = DeformationSettings { normals: NormalMethod::Exact, ..plain };
        let boxes = DeformationSettings { boxes: true, ..plain };
        let displacements = DeformationSettings { displacements: true, ..plain };
        let mut sizes = [(7, 0); 8];
        // Without modes, normals would not follow the surface.
        sizes[7].1 = 1;
        let entries = |deformation| max_change_entries(&followed(&sizes, deformation));
        // A quarter of sixteen domains may change; one is the transform root, and two have coordinates.
        assert_eq!([plain, exact, boxes, displacements].map(entries), [3, 4, 4, 3]);
        assert_eq!(max_change_entries(&deformed(&sizes, plain)), 4, "nobody follows");
        assert_eq!(max_changed_domains(&followed(&sizes, plain)), 4, "followers count among what changes");
        let truncated = DeformationSettings { truncation: Some(0.1), ..plain };
        assert_eq!(max_change_entries(&followed(&sizes, truncated)), 0);
    }
}
