// Arrays that are owned on the host and viewed, by their address, wherever they are stepped.
#pragma once

#include <vector>

#include "lanes.hpp"

namespace endopilot {

template <class T>
using Owned = std::vector<T>;
template <class T>
using Viewed = const T*;

// Where a processor steps, a view refers to the owner's own memory.
struct InPlace {
    template <class T>
    const T* operator()(const std::vector<T>& v) const {
        return v.data();
    }
};

}  // namespace endopilot
