// Programmatic dependent launch (compute capability 9.0 and later; src/compute/gpu/launch/kernel.rs): a kernel may start
// while the last blocks of the previous kernel on its stream still run. A kernel that is launched so must not access memory
// before `wait_for_prerequisite_grids`, and must call `launch_dependent_grids` only after that. The third kernel of a
// chain therefore starts after the first is complete.
#pragma once

// Returns when the previous kernel is complete and its writes are visible.
__device__ __forceinline__ void wait_for_prerequisite_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// The next kernel may start when every block has called this or has exited.
__device__ __forceinline__ void launch_dependent_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
