// The part of CUDA that src/core/cuda.cu uses, carried out by the processor: threads of a launch run one after the other.
#pragma once

#include <cstdlib>
#include <cstring>

#define __global__
#define __grid_constant__

enum cudaError_t { cudaSuccess, cudaErrorMemoryAllocation };
enum cudaMemcpyKind { cudaMemcpyHostToDevice, cudaMemcpyDeviceToHost };

struct dim3 {
    unsigned x = 1;
    dim3() = default;
    explicit dim3(unsigned n) : x(n) {}
};
struct cudaLaunchConfig_t {
    dim3 gridDim, blockDim;
};

inline dim3 blockIdx, blockDim, threadIdx;
inline int launches = 0;

inline const char* cudaGetErrorString(cudaError_t) { return "out of memory"; }
inline cudaError_t cudaGetDeviceCount(int* count) { return *count = 1, cudaSuccess; }
inline cudaError_t cudaDeviceSynchronize() { return cudaSuccess; }
template <class T>
cudaError_t cudaMalloc(T** to, std::size_t bytes) {
    *to = static_cast<T*>(std::malloc(bytes));
    return *to ? std::memset(*to, 0xff, bytes), cudaSuccess : cudaErrorMemoryAllocation;
}
inline cudaError_t cudaFree(void* data) { return std::free(data), cudaSuccess; }
inline cudaError_t cudaMemcpy(void* to, const void* from, std::size_t bytes, cudaMemcpyKind) {
    return bytes > 0 ? std::memcpy(to, from, bytes) : nullptr, cudaSuccess;
}
inline cudaError_t cudaMemset(void* to, int value, std::size_t bytes) {
    return bytes > 0 ? std::memset(to, value, bytes) : nullptr, cudaSuccess;
}

template <class Argument>
cudaError_t cudaLaunchKernelEx(const cudaLaunchConfig_t* grid, void (*kernel)(Argument), const Argument& argument) {
    ++launches;
    blockDim = grid->blockDim;
    for (blockIdx.x = 0; blockIdx.x < grid->gridDim.x; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < blockDim.x; ++threadIdx.x) kernel(argument);
    return cudaSuccess;
}
