//! Launches `kernels/apply.cu`, which reads new transforms and coordinates of changed domains directly from pinned
//! memory.

use cudarc::driver::{CudaFunction, LaunchConfig, PinnedHostSlice, PushKernelArg as _, sys};

use super::deform::config;
use super::device::Device;
use super::inputs::{Packing, Values};
use super::layout::{ApplyArgs, Change};
use super::plan::Kernel;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Scene, State};

/// A partial step pays off up to 1 / `MOST` of the domains; beyond that the whole state is copied.
const MOST: usize = 4;

/// The kernel, and the writer of the lists that it reads over the bus.
#[derive(Debug)]
pub struct Apply {
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
pub(super) type List = PinnedHostSlice<u32>;

/// Lengths of the lists of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Lengths {
    pub changed: u32,
    pub stale: u32,
}

/// Words of a [`Change`] and of a transform.
const CHANGE: usize = size_of::<Change>() / 4;
const TRANSFORM: usize = 12;

/// Maximum number of changed domains in a partial step; 0 where steps are always full: when the scene has too few
/// domains, or when it truncates modes. The set of truncated modes depends on q and is uploaded only with the whole
/// state.
pub(super) const fn most_domains(scene: &Scene) -> usize {
    if scene.needs.truncation { 0 } else { scene.domains.len() / MOST }
}

/// Maximum number of entries of such a list: silent domains have none.
pub(super) fn most_changes(scene: &Scene) -> usize {
    let silent = (0..scene.domains.len()).filter(|domain| is_silent(scene, *domain)).count();
    most_domains(scene).min(scene.domains.len() - silent)
}

/// Whether a step never has to send a change of this domain. Such a domain follows another domain's transform, has no
/// coordinates, and nobody reads its stamp, as exact normals and boxes would. Its tiles are computed again all the
/// same.
fn is_silent(scene: &Scene, domain: usize) -> bool {
    let needs = scene.needs;
    needs.followers
        && !(needs.exact_normals || needs.boxes)
        && scene.layout.slots[domain].rank == 0
        && scene.movers.frame_of(domain).is_some()
}

impl Apply {
    pub fn new(device: &Device, packing: &Packing, kernel: &Kernel) -> Result<Self> {
        let function = device.function(kernel.name, kernel.source.0, &kernel.defines)?;
        Ok(Self {
            function,
            config: config(kernel),
            most: most_changes(&packing.scene),
            coordinates: packing.coordinates.total,
            named: vec![0; packing.listing.tiles],
            lists: 0,
        })
    }

    /// Allocates pinned memory for the lists of a step.
    pub fn list(&self, device: &Device) -> Result<List> {
        let words = (CHANGE + TRANSFORM) * self.most + self.coordinates + self.named.len();
        let flags = sys::CU_MEMHOSTALLOC_WRITECOMBINED | sys::CU_MEMHOSTALLOC_DEVICEMAP;
        // SAFETY: the memory is uninitialized; the kernel reads only what `write` wrote.
        unsafe { device.context().alloc_pinned_with_flags(words, flags) }.map_err(during("allocate"))
    }

    /// Writes the lists of a partial step. `changed`: domains that the step changes. `behind`: further domains that the
    /// output lacks. The caller has waited for the last launch with `list`. Returns `None` when the lists have no
    /// capacity for the changes, or when a full step is less work.
    pub fn write(
        &mut self,
        list: &mut List,
        packing: &Packing,
        state: &State,
        (changed, behind): (&[u32], &[u32]),
    ) -> Result<Option<Lengths>> {
        let scene = &packing.scene;
        if changed.len() > most_domains(scene) {
            return Ok(None);
        }
        let words = list.as_mut_slice().map_err(during("upload"))?;
        let (changes, rest) = words.split_at_mut(CHANGE * self.most);
        let (transforms, rest) = rest.split_at_mut(TRANSFORM * self.most);
        let (q, tiles) = rest.split_at_mut(self.coordinates);
        let (mut source, mut count) = (0, 0);
        let told = changed.iter().filter(|domain| !is_silent(scene, **domain as usize));
        for (index, domain) in told.enumerate() {
            let (at, first) = (*domain as usize, source);
            // The kernel does not read the transform of a follower.
            let transform: [u32; TRANSFORM] = bytemuck::cast(state.transforms[scene.movers.of(at)].0);
            transforms[TRANSFORM * index..][..TRANSFORM].copy_from_slice(&transform);
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
            changes[CHANGE * index..][..CHANGE].copy_from_slice(bytemuck::cast_slice(&[change]));
            count += 1;
        }
        if self.lists == u32::MAX {
            self.named.fill(0);
            self.lists = 0;
        }
        self.lists += 1;
        // The values and stamps of the domains in `behind` are already on the device.
        let lacking = changed.iter().chain(behind);
        let stale = list_tiles(packing, lacking, (&mut self.named, self.lists), tiles);
        if stale as usize > packing.listing.whole {
            return Ok(None);
        }
        Ok(Some(Lengths { changed: count, stale }))
    }

    /// Starts the kernel. The header among `values` has the lengths of the lists. The kernel copies the tile list to
    /// `tiles`.
    pub fn launch(&self, device: &Device, list: &mut List, values: Values, tiles: u64) -> Result<()> {
        let fail = during("apply");
        let list = list.as_mut_ptr().map_err(&fail)? as u64;
        let new_transforms = list + 4 * (CHANGE * self.most) as u64;
        let new_q = new_transforms + 4 * (TRANSFORM * self.most) as u64;
        let args = ApplyArgs {
            header: values.header,
            changes: list,
            new_transforms,
            new_q,
            stale: new_q + 4 * self.coordinates as u64,
            following: values.following,
            transforms: values.transforms,
            q: values.q,
            stamps: values.stamps,
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
    packing: &Packing,
    domains: impl Iterator<Item = &'a u32>,
    (named, list): (&mut [u32], u32),
    tiles: &mut [u32],
) -> u32 {
    let mut count = 0;
    for domain in domains {
        for (first, length) in packing.listing.spans[*domain as usize] {
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
    use super::super::pack::tests::{deformed, followed};
    use super::*;
    use modalcast_model::scene::{Deformation, Normals};

    #[test]
    fn followers_without_coordinates_have_entries_where_somebody_asks_for_their_stamps_alone() {
        let plain = Deformation::default();
        let exact = Deformation { normals: Normals::Exact, ..plain };
        let boxes = Deformation { boxes: true, ..plain };
        let displacements = Deformation { displacements: true, ..plain };
        let mut sizes = [(7, 0); 8];
        // Without modes, normals would not follow the surface.
        sizes[7].1 = 1;
        let entries = |deformation| most_changes(&followed(&sizes, deformation));
        // A quarter of sixteen domains may change; one is the transform root, and two have coordinates.
        assert_eq!([plain, exact, boxes, displacements].map(entries), [3, 4, 4, 3]);
        assert_eq!(most_changes(&deformed(&sizes, plain)), 4, "nobody follows");
        assert_eq!(most_domains(&followed(&sizes, plain)), 4, "followers count among what changes");
        let truncated = Deformation { truncation: Some(0.1), ..plain };
        assert_eq!(most_changes(&followed(&sizes, truncated)), 0);
    }
}
