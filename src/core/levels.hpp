// Levels of processor instructions that the core is built for: one extension module each (CMakeLists.txt).
#pragma once

#include <string>
#include <vector>

namespace endopilot {

// The levels that are built and that this processor runs, slowest first. Ask the baseline module, which runs everywhere.
inline std::vector<std::string> supported_levels() {
    std::vector<std::string> levels{"baseline"};
#ifdef __x86_64__
    __builtin_cpu_init();
    const bool avx2 = __builtin_cpu_supports("avx2");
    if (avx2) levels.push_back("avx2");
    if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        levels.push_back("avx512");
#endif
    return levels;
}

}  // namespace endopilot
