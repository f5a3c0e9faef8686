// Programmatic dependent launch (compute capability 9.0 and later; src/compute/gpu/launch/kernel.rs): a kernel may
// start while the last blocks of the previous kernel on its stream still run. A kernel with such a launch must not
// access memory before it calls `wait_for_prerequisite_grids`, and must call `launch_dependent_grids` only after this
// wait. In a chain of three kernels, the third one therefore starts after the first one is complete.
#pragma once

// Returns when the previous kernel is complete and its writes are visible.
__device__ __forceinline__ void wait_for_prerequisite_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Allows the next kernel to start when every block has called this function or has exited.
__device__ __forceinline__ void launch_dependent_grids() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
