// Programmatic dependent launch (compute capability 9.0 and later; src/compute/gpu/launch/kernel.rs): a kernel may be scheduled
// while the last blocks of the previous kernel on its stream still run. It accesses no memory before `wait_on_dependent_grids`,
// and calls `launch_dependent_grids` only after that. The third kernel of a chain therefore finds the results of the first
// complete.
#pragma once

// Returns when all writes of the previous kernel are visible.
__device__ __forceinline__ void wait_on_dependent_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Allows the next kernel to start once every block has called this or has ended.
__device__ __forceinline__ void launch_dependent_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
