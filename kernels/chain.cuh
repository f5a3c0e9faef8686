// A kernel behind another on its stream may be put onto the device while the last blocks of the other still run
// (programmatic dependent launch, compute capability 9.0 and later; src/compute/gpu/chain.rs). It touches nothing before it has
// waited, and the next one is let in only after that: whoever comes third finds the first complete.
#pragma once

// Returns when all that the kernel before wrote is there.
__device__ __forceinline__ void await_previous() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Lets the next kernel in once every block has come here or has ended.
__device__ __forceinline__ void admit_next() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
