// Projection of tips to the centerline tree: a tip's abscissa, its offset, its branch and the lumen's radius there. What it
// means, and how the vertices to begin at are found, stands in endopilot/anatomy/projection.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "lanes.hpp"

namespace endopilot {

// A vertex of a centerline; those of a branch stand one after another.
struct Vertex {
    Vec3<double> point, tangent;        // mm, unit vector
    double abscissa, radius;            // mm
    std::int64_t first, last, branch;   // the first and the last vertex of its branch, and the branch
};

// The other branches that a point may lie deeper in, by the vertex that is nearest to it.
struct Candidate {
    double from;          // mm that the point must be away from the vertex; infinite where it cannot be
    std::int64_t entry;   // the branch's vertex that is nearest to this one
};

struct Projected {
    double abscissa, offset, radius;   // mm
    std::int64_t branch;
};

// The catheter: its axis behind the ostium, and its radius, which is the vessel's at the ostium.
struct Catheter {
    Vec3<double> ostium, axis;
    double radius;
};

class Projector {
public:
    // `candidates`: for each vertex, one for each branch.
    Projector(std::vector<Vertex> vertices, std::vector<Candidate> candidates, const Catheter& catheter)
        : vertex_(std::move(vertices)), candidate_(std::move(candidates)), catheter_(catheter), branches_(candidate_.size() / vertex_.size()) {
        for (std::size_t v = 0; v < vertex_.size(); ++v) segment_.push_back(make_segment(std::int64_t(v)));
    }

    std::size_t vertices() const { return vertex_.size(); }

    // Projects a point whose nearest vertex is `nearest`, `distance` mm away: onto the branch whose lumen it lies deepest in.
    Projected operator()(const Vec3<double>& point, std::int64_t nearest, double distance) const {
        Projected best = onto(point, nearest);
        const Candidate* candidate = &candidate_[std::size_t(nearest) * branches_];
        for (std::size_t b = 0; b < branches_; ++b)
            if (candidate[b].from < distance) {
                const Projected other = onto(point, nearest_on_branch(point, candidate[b].entry));
                if (other.offset * best.radius < best.offset * other.radius) best = other;
            }
        const Vec3<double> relative = point - catheter_.ostium;
        const double depth = dot(relative, catheter_.axis);
        if (depth >= 0) return best;
        const Vec3<double> across = relative - depth * catheter_.axis;
        const double offset = std::sqrt(dot(across, across));
        return offset * best.radius <= best.offset * catheter_.radius ? Projected{depth, offset, catheter_.radius, 0} : best;
    }

private:
    static constexpr int kMaxCorrections = 4;  // of a vertex, by the point's distance to its plane

    // The segment from a vertex to the next; the last vertex of a branch has the segment before it.
    struct Segment {
        Vec3<double> ahead;                         // the vertex's tangent over the segment's length, 1/mm
        Vec3<double> start, edge, tangent, change;  // of the segment; its tangent turns by `change` along it
        double edge_tangent, edge_change;           // edge · tangent, edge · change
        double abscissa, abscissa_change, radius, radius_change;  // at its start, and their changes along it
    };

    std::vector<Vertex> vertex_;
    std::vector<Candidate> candidate_;
    std::vector<Segment> segment_;
    Catheter catheter_;
    std::size_t branches_;

    Segment make_segment(std::int64_t v) const {
        const Vertex& here = vertex_[std::size_t(v)];
        const std::int64_t start = v == here.last ? std::max(v - 1, here.first) : v;
        const Vertex &a = vertex_[std::size_t(start)], &b = vertex_[std::size_t(std::min(start + 1, here.last))];
        const Vec3<double> edge = b.point - a.point, change = b.tangent - a.tangent;
        const double length = std::max(std::sqrt(dot(edge, edge)), 1e-9);
        return {.ahead = (1.0 / length) * here.tangent,
                .start = a.point,
                .edge = edge,
                .tangent = a.tangent,
                .change = change,
                .edge_tangent = dot(edge, a.tangent),
                .edge_change = dot(edge, change),
                .abscissa = a.abscissa,
                .abscissa_change = b.abscissa - a.abscissa,
                .radius = a.radius,
                .radius_change = b.radius - a.radius};
    }

    // How far a point lies before the plane of a vertex, in segments.
    double ahead(const Vec3<double>& point, std::int64_t v) const {
        return dot(point - vertex_[std::size_t(v)].point, segment_[std::size_t(v)].ahead);
    }

    // Walks along a branch from a vertex to the one that is nearest to a point.
    std::int64_t nearest_on_branch(const Vec3<double>& point, std::int64_t v) const {
        const double first = double(vertex_[std::size_t(v)].first), last = double(vertex_[std::size_t(v)].last);
        for (int i = 0; i < kMaxCorrections; ++i) {
            const auto next = std::int64_t(std::clamp(double(v) + std::nearbyint(ahead(point, v)), first, last));
            if (next == v) break;
            v = next;
        }
        return v;
    }

    // Projects a point onto the segment before or behind a vertex, by the side of its plane that it lies on. With q = p - a,
    // edge e, tangent T at a and its change D, the share u solves (q - ue)·(T + uD) = 0: q·T - u(e·T - q·D) - u² e·D = 0, of
    // whose roots the one that stays finite as D vanishes is wanted.
    Projected onto(const Vec3<double>& point, std::int64_t v) const {
        const Vertex& here = vertex_[std::size_t(v)];
        const Segment& s = segment_[std::size_t(ahead(point, v) < 0 ? std::max(v - 1, here.first) : v)];
        const Vec3<double> q = point - s.start;
        const double depth = dot(q, s.tangent), slope = s.edge_tangent - dot(q, s.change);
        const double root = std::sqrt(std::max(slope * slope + 4.0 * s.edge_change * depth, 0.0));
        const double share = std::clamp(2.0 * depth / std::max(slope + root, 1e-12), 0.0, 1.0);
        const Vec3<double> off = q - share * s.edge;
        return {.abscissa = s.abscissa + share * s.abscissa_change,
                .offset = std::sqrt(dot(off, off)),
                .radius = s.radius + share * s.radius_change,
                .branch = here.branch};
    }
};

}  // namespace endopilot
