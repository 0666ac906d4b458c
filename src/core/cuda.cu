// Worlds on a CUDA GPU: memory, copies and launches around `step_worlds`.
#include "cuda.hpp"

#include <cuda_runtime.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "kernel.hpp"

namespace endopilot {

constexpr int kBlock = 32;            // threads: one warp, so that few worlds still spread over all multiprocessors
constexpr int kMostNodes = 480;      // a thread's local memory has 512 KiB
constexpr int kSamplesPerLaunch = 4;  // launches are short, so that a run can be interrupted between them

static void check(cudaError_t error) {
    if (error != cudaSuccess) throw std::runtime_error(std::string("the GPU reports: ") + cudaGetErrorString(error));
}

// An array in the GPU's memory.
class Buffer {
public:
    explicit Buffer(std::size_t bytes) {
        if (bytes > 0) check(cudaMalloc(&data_, bytes));
    }
    Buffer(Buffer&& other) noexcept : data_(std::exchange(other.data_, nullptr)) {}
    Buffer& operator=(Buffer&&) = delete;
    ~Buffer() { cudaFree(data_); }
    void* data() const { return data_; }

private:
    void* data_ = nullptr;
};

// A node's working memory is local to its thread: the GPU lays local memory out so that the threads of a warp, which work on
// the same node, read and write side by side.
template <int Nodes>
__global__ void step_kernel(const __grid_constant__ Launch launch) {
    Node<double> node[Nodes];
    Factor<double> factor[Nodes];
    step_worlds(launch, int(blockIdx.x * blockDim.x + threadIdx.x), node, factor);
}

using Kernel = void (*)(Launch);

// The kernel with the least memory for so many nodes.
static Kernel kernel_for(int nodes) {
    if (nodes <= 128) return step_kernel<128>;
    if (nodes <= 256) return step_kernel<256>;
    if (nodes <= kMostNodes) return step_kernel<kMostNodes>;
    throw std::runtime_error("a GPU steps wires of at most " + std::to_string(kMostNodes) + " nodes, not of " + std::to_string(nodes));
}

struct CudaStepper::Memory {
    std::vector<Buffer> buffers;

    template <class T>
    T* allocate(std::size_t count) {
        return static_cast<T*>(buffers.emplace_back(count * sizeof(T)).data());
    }
    // Puts a vector there.
    template <class T>
    T* operator()(const std::vector<T>& v) {
        T* to = allocate<T>(v.size());
        check(cudaMemcpy(to, v.data(), v.size() * sizeof(T), cudaMemcpyHostToDevice));
        return to;
    }
};

std::string why_no_gpu() {
    int count = 0;
    const cudaError_t error = cudaGetDeviceCount(&count);
    if (error != cudaSuccess) return cudaGetErrorString(error);
    return count > 0 ? "" : "no GPU found";
}

CudaStepper::CudaStepper(const OwnedScene& scene)
    : memory_(std::make_unique<Memory>()), scene_(view(scene, [this](const auto& v) { return (*memory_)(v); })) {
    kernel_for(scene_.rod.nodes);
}

CudaStepper::~CudaStepper() = default;

void CudaStepper::step(const Worlds& worlds, const Inputs& in, const Outputs& out, const std::vector<int>& order,
                       const std::function<void(long)>& progress) {
    const std::size_t count = order.size(), width = World::size(scene_.rod.nodes);
    Memory memory;
    Launch launch{.scene = scene_,
                  .worlds = {},
                  .in = in,
                  .out = out,
                  .count = int(count),
                  .order = memory(order),
                  .next = memory(std::vector<int>(count, 0)),
                  .samples = kSamplesPerLaunch};

    // The same number of all worlds side by side.
    std::vector<double> values(count * width);
    double most = 0;
    for (std::size_t w = 0; w < count; ++w) {
        const World world = worlds[w];
        most = std::max(most, world[World::kApproach]);
        for (std::size_t k = 0; k < width; ++k) values[k * count + w] = world.values[std::ptrdiff_t(k) * world.stride];
    }
    launch.worlds = {memory(values), 1, std::ptrdiff_t(count)};
    launch.in.control = memory(std::vector<double>(in.control, in.control + 2 * count * std::size_t(in.samples)));

    struct Copy {
        void* to;
        const void* from;
        std::size_t bytes;
    };
    std::vector<Copy> copies;
    each_array(launch.out, std::size_t(in.samples), std::size_t(scene_.rod.nodes), [&](auto*& array, std::size_t numbers) {
        auto* const host = array;
        const std::size_t bytes = count * numbers * sizeof(*host);
        array = memory.allocate<std::remove_reference_t<decltype(*host)>>(count * numbers);
        check(cudaMemset(array, 0, bytes));
        copies.push_back({host, array, bytes});
    });

    const long samples = long(most) + in.samples, launches = (samples + kSamplesPerLaunch - 1) / kSamplesPerLaunch;
    cudaLaunchConfig_t grid{};
    grid.gridDim = dim3(unsigned(count + kBlock - 1) / kBlock);
    grid.blockDim = dim3(kBlock);
    long done = 0;
    for (long k = 1; k <= launches; ++k) {
        check(cudaLaunchKernelEx(&grid, kernel_for(scene_.rod.nodes), launch));
        check(cudaDeviceSynchronize());
        const long now = long(count) * in.samples * k / launches;
        progress(now - done);
        done = now;
    }

    check(cudaMemcpy(values.data(), launch.worlds.values, values.size() * sizeof(double), cudaMemcpyDeviceToHost));
    for (std::size_t w = 0; w < count; ++w) {
        const World world = worlds[w];
        for (std::size_t k = 0; k < width; ++k) world.values[std::ptrdiff_t(k) * world.stride] = values[k * count + w];
    }
    for (const Copy& copy : copies) check(cudaMemcpy(copy.to, copy.from, copy.bytes, cudaMemcpyDeviceToHost));
}

}  // namespace endopilot
