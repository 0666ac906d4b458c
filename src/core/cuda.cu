// Worlds on a CUDA GPU: memory, copies and launches around `step_worlds`.
#include "cuda.hpp"

#include <cuda_runtime.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "kernel.hpp"

namespace endopilot {

constexpr int kBlock = 32;            // threads: one warp, so that few worlds still spread over all multiprocessors
constexpr std::size_t kLocalMemory = 512 * 1024;   // of a thread, bytes
constexpr int kMostNodes[] = {480, 320, 256};      // that it holds, of a wire, and of one with one and two catheters
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
template <int Nodes, int T>
__global__ void step_kernel(const __grid_constant__ Launch launch) {
    static_assert(Nodes * (sizeof(Node<double, T>) + sizeof(Factor<double, T>)) <= kLocalMemory);
    Node<double, T> node[Nodes];
    Factor<double, T> factor[Nodes];
    step_worlds<T>(launch, int(blockIdx.x * blockDim.x + threadIdx.x), node, factor);
}

using Kernel = void (*)(Launch);

// The kernel with the least memory for so many nodes, with T catheters around the wire.
template <int T>
static Kernel kernel_for(int nodes) {
    if (nodes <= 128) return step_kernel<128, T>;
    if (nodes <= 256) return step_kernel<256, T>;
    if (nodes <= kMostNodes[T]) return step_kernel<kMostNodes[T], T>;
    throw std::runtime_error("a GPU steps devices of at most " + std::to_string(kMostNodes[T]) + " nodes, not of " + std::to_string(nodes));
}

static Kernel kernel_for(int nodes, int devices) {
    return devices == 1 ? kernel_for<0>(nodes) : devices == 2 ? kernel_for<1>(nodes) : kernel_for<2>(nodes);
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
    kernel_for(scene_.rod.nodes, scene_.drives.count);
}

CudaStepper::~CudaStepper() = default;

void CudaStepper::step(const Worlds& worlds, const Inputs& in, const Outputs& out, const std::vector<int>& order, int, int,
                       const Progress& progress) {
    const std::size_t count = std::size_t(in.worlds), samples = std::size_t(in.samples), devices = std::size_t(scene_.drives.count);
    const std::size_t width = World::size(scene_.rod.nodes, scene_.drives.count);
    Memory memory;
    Launch launch{.run = {scene_, {}, in, out},
                  .count = int(order.size()),
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
    launch.run.worlds = {memory(values), 1, std::ptrdiff_t(count), scene_.drives.count};
    launch.run.in.control = memory(std::vector<double>(in.control, in.control + 2 * devices * count * samples));

    struct Copy {
        void* to;
        const void* from;
        std::size_t bytes;
    };
    std::vector<Copy> copies;
    each_output(launch.run.out, [&]<class Number>(const char*, Number*& array, Of of, int numbers) {
        if (!array) return;   // not recorded
        Number* const host = array;
        const std::size_t size = count * entries(of, samples, devices, std::size_t(scene_.rod.nodes)) * std::size_t(numbers);
        array = memory.allocate<Number>(size);
        check(cudaMemset(array, 0, size * sizeof(Number)));
        copies.push_back({host, array, size * sizeof(Number)});
    });

    const long steps = long(most) + in.samples, launches = (steps + kSamplesPerLaunch - 1) / kSamplesPerLaunch;
    cudaLaunchConfig_t grid{};
    grid.gridDim = dim3(std::max(1u, unsigned(order.size() + kBlock - 1) / kBlock));
    grid.blockDim = dim3(kBlock);
    long done = 0;
    for (long k = 1; k <= launches; ++k) {
        check(cudaLaunchKernelEx(&grid, kernel_for(scene_.rod.nodes, scene_.drives.count), launch));
        check(cudaDeviceSynchronize());
        const long now = long(order.size()) * in.samples * k / launches;
        progress(now - done);
        done = now;
    }

    check(cudaMemcpy(values.data(), launch.run.worlds.values, values.size() * sizeof(double), cudaMemcpyDeviceToHost));
    for (std::size_t w = 0; w < count; ++w) {
        const World world = worlds[w];
        for (std::size_t k = 0; k < width; ++k) world.values[std::ptrdiff_t(k) * world.stride] = values[k * count + w];
    }
    for (const Copy& copy : copies) check(cudaMemcpy(copy.to, copy.from, copy.bytes, cudaMemcpyDeviceToHost));
}

}  // namespace endopilot
