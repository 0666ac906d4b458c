// Tests of the core's headers against their meaning: lane types against scalars, the block solver against a dense one,
// gradients and Hessians against finite differences. Built with sanitizers and run by test_core_cpp.py.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <random>
#include <string>

#include "core_adapter.hpp"
#include "projection.hpp"
#include "refined.hpp"

using namespace adapter;

namespace {

int failures = 0;
std::mt19937_64 generator(7);

double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(generator); }

void expect(bool fine, const std::string& what) {
    if (fine) return;
    std::printf("FAILED: %s\n", what.c_str());
    ++failures;
}

void expect_near(double value, double expected, double tolerance, const std::string& what) {
    const bool fine = std::abs(value - expected) <= tolerance;  // false for NaN
    if (!fine) std::printf("%.12g, expected %.12g\n", value, expected);
    expect(fine, what);
}

template <class V>
V random_lanes(double low, double high) {
    V v{};
    for (int l = 0; l < kWidth<V>; ++l) set(v, l, uniform(low, high));
    return v;
}

template <class V>
Quaternion<V> random_rotation() {
    const Vec3<V> angle{random_lanes<V>(-1, 1), random_lanes<V>(-1, 1), random_lanes<V>(-1, 1)};
    return rotated(Quaternion<V>{broadcast<V>(1.0), {V{}, V{}, V{}}}, angle);
}

Vec3<double> lane_of(const auto& v, int l) { return {get(v.x, l), get(v.y, l), get(v.z, l)}; }

void expect_same(const Vec3<double>& a, const Vec3<double>& b, const std::string& what) {
    expect_near(a.x, b.x, 1e-14, what);
    expect_near(a.y, b.y, 1e-14, what);
    expect_near(a.z, b.z, 1e-14, what);
}

template <class V>
void test_lanes() {
    const std::string width = std::to_string(kWidth<V>) + " lanes: ";
    for (int trial = 0; trial < 20; ++trial) {
        const Vec3<V> a{random_lanes<V>(-2, 2), random_lanes<V>(-2, 2), random_lanes<V>(-2, 2)};
        const Vec3<V> b{random_lanes<V>(-2, 2), random_lanes<V>(-2, 2), random_lanes<V>(-2, 2)};
        const Quaternion<V> p = random_rotation<V>(), q = random_rotation<V>();
        const V root = square_root(dot(a, a)), larger = maximum(a.x, b.x), chosen = select<V>(a.x > b.x, a.y, b.y);
        const Vec3<V> product = cross(a, b);
        const Quaternion<V> between = relative(p, q), back = p * between;
        const Frame<V> axes = frame(p);
        for (int l = 0; l < kWidth<V>; ++l) {
            const Vec3<double> x = lane_of(a, l), y = lane_of(b, l);
            expect_near(get(root, l), std::sqrt(x.x * x.x + x.y * x.y + x.z * x.z), 1e-14, width + "root");
            expect_near(get(larger, l), std::max(x.x, y.x), 0, width + "maximum");
            expect_near(get(chosen, l), x.x > y.x ? x.y : y.y, 0, width + "select");
            expect_same(lane_of(product, l), cross(x, y), width + "cross");
            expect_near(get(back.w, l), get(q.w, l), 1e-14, width + "p (p* q) = q");
            expect_same(lane_of(back.v, l), lane_of(q.v, l), width + "p (p* q) = q");
            expect_same(cross(lane_of(axes.d1, l), lane_of(axes.d2, l)), lane_of(axes.d3, l), width + "frame");
            // R(p) e3 = p e3 p*, by the product of quaternions alone
            const Quaternion<double> pl{get(p.w, l), lane_of(p.v, l)};
            const Quaternion<double> turned_axis = pl * Quaternion<double>{0, {0, 0, 1}} * Quaternion<double>{pl.w, -1.0 * pl.v};
            expect_same(lane_of(axes.d3, l), turned_axis.v, width + "third director");
        }
    }
}

// Gaussian elimination with pivoting: an independent solver.
std::vector<double> solve_dense(std::vector<std::vector<double>> a, std::vector<double> b) {
    const int n = int(b.size());
    for (int c = 0; c < n; ++c) {
        int best = c;
        for (int r = c + 1; r < n; ++r)
            if (std::abs(a[r][c]) > std::abs(a[best][c])) best = r;
        std::swap(a[c], a[best]);
        std::swap(b[c], b[best]);
        for (int r = c + 1; r < n; ++r) {
            const double factor = a[r][c] / a[c][c];
            for (int k = c; k < n; ++k) a[r][k] -= factor * a[c][k];
            b[r] -= factor * b[c];
        }
    }
    for (int r = n - 1; r >= 0; --r) {
        for (int k = r + 1; k < n; ++k) b[r] -= a[r][k] * b[k];
        b[r] /= a[r][r];
    }
    return b;
}

template <class V>
void test_solver() {
    const int n = 7;
    std::vector<Matrix> own(n), coupling(n);
    std::vector<Vector> gradient(n);
    std::vector<std::vector<double>> dense(6 * n, std::vector<double>(6 * n));
    std::vector<double> right(6 * n);
    for (int i = 0; i < n; ++i) {
        for (int r = 0; r < 6; ++r) {
            for (int c = 0; c <= r; ++c) own[i][r][c] = own[i][c][r] = uniform(-1, 1) + (r == c ? 9.0 : 0.0);
            for (int c = 0; c < 6; ++c) coupling[i][r][c] = r < 3 && c >= 3 ? 0.0 : uniform(-1, 1);
            gradient[i][r] = uniform(-1, 1);
        }
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < r; ++c) coupling[i][r][c] = coupling[i][c][r];
        for (int r = 0; r < 6; ++r) {
            right[6 * i + r] = -gradient[i][r];
            for (int c = 0; c < 6; ++c) {
                dense[6 * i + r][6 * i + c] = own[i][r][c];
                if (i + 1 < n) dense[6 * i + r][6 * i + 6 + c] = dense[6 * i + 6 + c][6 * i + r] = coupling[i][r][c];
            }
        }
    }
    bool positive = false;
    const auto solution = solve_chain<V>(own, coupling, gradient, positive);  // in single precision
    const std::vector<double> expected = solve_dense(dense, right);
    expect(positive, "a diagonally dominant system has positive pivots");
    for (int l = 0; l < kWidth<V>; ++l)
        for (int i = 0; i < n; ++i)
            for (int r = 0; r < 6; ++r)
                expect_near(solution[l][i][r], (l + 1) * expected[6 * i + r], (l + 1) * 1e-6,
                            "solution in lane " + std::to_string(l) + " of " + std::to_string(kWidth<V>));
    own[n / 2][4][4] = -9.0;
    solve_chain<V>(own, coupling, gradient, positive);
    expect(!positive, "an indefinite system is told by its pivots");
}

// A chain of nodes, stiff in each of its links and held by next to nothing: single precision would not see what holds it beside the
// links' stiffness. Under a force on each node it moves by force / held as a whole, but for the links' stretch.
void test_stiff_chain() {
    const int n = 40;
    const double stiff = 1e5, held = 1e-4, force = 2e-4;
    std::vector<Matrix> own(n), coupling(n);
    std::vector<Vector> gradient(n);
    for (int i = 0; i < n; ++i)
        for (int r = 0; r < 6; ++r) {
            own[i][r][r] = r < 3 ? held + ((i > 0) + (i + 1 < n)) * stiff : 1.0;
            if (r < 3) coupling[i][r][r] = -stiff;
            if (r < 3) gradient[i][r] = -force;
        }
    bool positive = false;
    const auto solution = solve_chain<double>(own, coupling, gradient, positive);
    expect(positive, "a chain held by next to nothing has positive pivots");
    for (int i = 0; i < n; ++i)
        for (int r = 0; r < 3; ++r) expect_near(solution[0][i][r], force / held, 1e-5, "motion of a stiff chain");
}

// The gradient of a force at the middle of two nodes goes half to each, its Hessian in quarters; rotations are the first block's.
void test_middle() {
    const auto f = [] { return float(uniform(-1, 1)); };
    const auto s = [&] { return Sym3<float>{f(), f(), f(), f(), f(), f()}; };
    const Diagonal<double> middle{{f(), f(), f()}, {f(), f(), f()}, s(), {{f(), f(), f()}, {f(), f(), f()}, {f(), f(), f()}}, s(), {}};
    const Vector gradient = gradient_of(middle);
    const Matrix hessian = hessian_of(middle);
    const Pair pair = middle_of(middle);
    for (int a = 0; a < 6; ++a) {
        const double of_a = a < 3 ? 0.5 : 1.0;
        expect_near(pair.gradient[0][a], of_a * gradient[a], 1e-15, "gradient at the middle, first block");
        expect_near(pair.gradient[1][a], a < 3 ? 0.5 * gradient[a] : 0.0, 1e-15, "gradient at the middle, second block");
        for (int b = 0; b < 6; ++b) {
            const double of_b = b < 3 ? 0.5 : 1.0;
            expect_near(pair.own[0][a][b], of_a * of_b * hessian[a][b], 1e-6, "Hessian at the middle, first block");
            expect_near(pair.own[1][a][b], a < 3 && b < 3 ? 0.25 * hessian[a][b] : 0.0, 1e-6, "Hessian at the middle, second block");
            expect_near(pair.coupling[a][b], b < 3 ? 0.5 * of_a * hessian[a][b] : 0.0, 1e-6, "coupling at the middle");
        }
    }
}

Pose moved(const Pose& pose, int unknown, double by) {
    Pose out = pose;
    double step[6] = {};
    step[unknown] = by;
    out.x += Vec3<double>{step[0], step[1], step[2]};
    // exactly the rotation vector `step`, where rotated() agrees with it to second order
    const double half = 0.5 * by;
    const Quaternion<double> turn{unknown < 3 ? 1.0 : std::cos(half), {unknown == 3 ? std::sin(half) : 0, unknown == 4 ? std::sin(half) : 0,
                                                                      unknown == 5 ? std::sin(half) : 0}};
    out.q = pose.q * turn;
    return out;
}

// d2/da db of E by central differences of the energy alone; rotations about two axes of one body are averaged over
// both orders, which is how the Hessian on rotation vectors is symmetric.
template <class Energy>
double second_difference(const Energy& energy, const Pose (&poses)[2], int block_a, int a, int block_b, int b, double h) {
    double sum = 0;
    for (int order = 0; order < 2; ++order)
        for (int sa = -1; sa <= 1; sa += 2)
            for (int sb = -1; sb <= 1; sb += 2) {
                Pose p[2] = {poses[0], poses[1]};
                if (order == 0) p[block_a] = moved(p[block_a], a, sa * h);
                p[block_b] = moved(p[block_b], b, sb * h);
                if (order == 1) p[block_a] = moved(p[block_a], a, sa * h);
                sum += sa * sb * energy(p);
            }
    return sum / (8 * h * h);
}

Rod two_element_rod() {
    Rod rod;
    rod.nodes = 3;
    rod.abscissa = {0, 0.8, 2.0};
    rod.length = {0.8, 1.2, 1.0};
    rod.shear = {3.0, 4.0, 4.0};
    rod.stretch = {7.0, 9.0, 9.0};
    rod.joint_length = {1.0, 1.0, 1.0};
    rod.bend = {2.0, 2.5, 2.5};
    rod.twist = {1.5, 1.1, 1.1};
    rod.rest = {{0, 0, 0}, {0.3, -0.2, 0.1}, {0, 0, 0}};
    rod.radius = rod.drag = rod.spin_drag = {0.1, 0.1, 0.1};
    return rod;
}

// The joint's Hessian leaves out the derivatives of g, so it holds to the order of strain: of |v|² where the rest
// curvature is 0, of |v| times the moment elsewhere. Gradients are exact at any strain.
void test_elastic_energy(double bent, double rest, double tolerance, double share = 1.0) {
    Rod owned = two_element_rod();
    owned.rest[1] = rest * owned.rest[1];
    const RodModel rod = view(owned, InPlace{});
    for (int trial = 0; trial < 4; ++trial) {
        const auto start = random_rotation<double>();
        const Vec3<double> bend{uniform(-bent, bent), uniform(-bent, bent), uniform(-bent, bent)};
        const Vec3<double> along = 0.8 * frame(start).d3, off{uniform(-0.2, 0.2), uniform(-0.2, 0.2), uniform(-0.2, 0.2)};
        const Pose poses[2] = {{along + off, rotated(start, bend)}, {{0, 0, 0}, start}};
        const auto energy = [&](const Pose (&p)[2]) { return elastic_energy(rod, p[0], p[1], 1.0, share).energy; };
        const Pair exact = elastic_energy(rod, poses[0], poses[1], 1.0, share);
        expect(exact.energy > 0, "a strained rod has energy");
        for (int block = 0; block < 2; ++block)
            for (int a = 0; a < 6; ++a) {
                const double h = 1e-5;
                Pose up[2] = {poses[0], poses[1]}, down[2] = {poses[0], poses[1]};
                up[block] = moved(poses[block], a, h);
                down[block] = moved(poses[block], a, -h);
                const std::string at = ", block " + std::to_string(block) + ", unknown " + std::to_string(a);
                expect_near(exact.gradient[block][a], (energy(up) - energy(down)) / (2 * h), 1e-8, "elastic gradient" + at);
                for (int b = 0; b < 6 && tolerance > 0; ++b) {
                    const double own = second_difference(energy, poses, block, a, block, b, 1e-3);
                    expect_near(exact.own[block][a][b], own, tolerance, "elastic Hessian" + at + "," + std::to_string(b));
                    if (block == 1) continue;
                    const double mixed = second_difference(energy, poses, 0, a, 1, b, 1e-3);
                    expect_near(exact.coupling[a][b], mixed, tolerance, "elastic coupling" + at + "," + std::to_string(b));
                }
            }
    }
}

// Without its geometric terms the Hessian is J^T K J: no direction has negative curvature, but for single precision's rounding.
void test_gauss_newton() {
    const Rod owned = two_element_rod();
    const RodModel rod = view(owned, InPlace{});
    for (int trial = 0; trial < 50; ++trial) {
        const auto start = random_rotation<double>();
        const Pose distal{{uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)}, random_rotation<double>()};
        const Pair gauss = elastic_energy(rod, distal, {{0, 0, 0}, start}, 0.0);
        Vector u[2];
        for (auto& part : u)
            for (double& c : part) c = uniform(-1, 1);
        double form = 0;
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 6; ++c)
                form += u[0][r] * gauss.own[0][r][c] * u[0][c] + u[1][r] * gauss.own[1][r][c] * u[1][c] +
                        2 * u[0][r] * gauss.coupling[r][c] * u[1][c];
        expect(form > -1e-5, "Gauss-Newton part is positive semidefinite");
    }
}

constexpr int kSize[3] = {21, 18, 13};  // no multiples of a brick's edge
constexpr double kSpacing = 0.5;

LumenMap make_map(double near) {
    // coefficients of a curved field; quadratic B-splines of them are smooth whatever they are
    std::vector<float> c;
    for (int k = 0; k < kSize[2]; ++k)
        for (int j = 0; j < kSize[1]; ++j)
            for (int i = 0; i < kSize[0]; ++i)
                c.push_back(float(1.5 - 0.3 * std::hypot(0.5 * j - 4.0, 0.5 * k - 3.0) + 0.1 * std::sin(0.9 * i + 0.4 * k)));
    const double origin[3] = {-2.0, -4.0, -3.0};
    return make_lumen_map(c.data(), kSize, origin, kSpacing, near, 0.5);
}

template <class V>
void test_distance() {
    const LumenMap map = make_map(1e9);
    const Lumen lumen = view(map, InPlace{});
    const double h = 1e-4;
    for (int trial = 0; trial < 100; ++trial) {
        const Vec3<V> x{random_lanes<V>(-1.9, 7.7), random_lanes<V>(-3.9, 4.2), random_lanes<V>(-2.9, 2.7)};
        const auto value = [&](int axis, double by) {
            Vec3<V> at = x;
            (axis == 0 ? at.x : axis == 1 ? at.y : at.z) += by;
            return distance_to_wall<V>(lumen, at);
        };
        const Distance<V> d = distance_to_wall<V>(lumen, x);
        for (int axis = 0; axis < 3; ++axis) {
            const Distance<V> up = value(axis, h), down = value(axis, -h);
            const Vec3<Single<V>> columns[3] = {{d.hessian.xx, d.hessian.xy, d.hessian.xz}, {d.hessian.xy, d.hessian.yy, d.hessian.yz}, {d.hessian.xz, d.hessian.yz, d.hessian.zz}};
            for (int l = 0; l < kWidth<V>; ++l) {
                const Vec3<double> slope = lane_of(d.gradient, l), column = lane_of(columns[axis], l);
                const double s[3] = {slope.x, slope.y, slope.z};
                expect_near(s[axis], (get(up.value, l) - get(down.value, l)) / (2 * h), 1e-3 * h + 1e-8, "slope of the distance");
                // the spline's second derivative jumps between cells: stay off their borders
                const double places[3] = {get(x.x, l) + 2.0, get(x.y, l) + 4.0, get(x.z, l) + 3.0};
                const double place = places[axis] / kSpacing + 0.5;
                if (std::abs(place - std::round(place)) < 4 * h) continue;
                // the Hessian is in single precision
                const Vec3<double> change = (1 / (2 * h)) * (lane_of(up.gradient, l) - lane_of(down.gradient, l));
                expect_near(column.x, change.x, 1e-6, "curve of the distance");
                expect_near(column.y, change.y, 1e-6, "curve of the distance");
                expect_near(column.z, change.z, 1e-6, "curve of the distance");
            }
        }
    }
}

// The spline through random values takes them at the grid's points.
void test_spline_coefficients() {
    const int size[3] = {21, 13, 10};
    const double origin[3] = {1, 2, 3}, spacing = 0.5;
    std::mt19937 random(11);
    std::uniform_real_distribution<float> any(-1.0f, 1.0f);
    std::vector<float> values(std::size_t(size[0]) * size[1] * size[2]);
    for (float& v : values) v = any(random);
    const LumenMap map = make_lumen_map(spline_coefficients(values.data(), size).data(), size, origin, spacing, 1e9, 1e9);
    const Lumen lumen = view(map, InPlace{});
    for (int z = 1; z + 1 < size[2]; ++z)
        for (int y = 1; y + 1 < size[1]; ++y)
            for (int x = 1; x + 1 < size[0]; ++x) {
                const Vec3<double> at{origin[0] + spacing * x, origin[1] + spacing * y, origin[2] + spacing * z};
                const double value = values[(std::size_t(z) * size[1] + y) * size[0] + x];
                expect_near(distance_to_wall<double>(lumen, at).value, value, 2e-5, "the spline takes the values of the map");
            }
}

// On a finer grid a quadratic field stays as it is, and in a narrow tube the axis is as far from the wall as the tube is wide, which the
// coarse spline rounds off.
void test_refined_map() {
    const int size[3] = {21, 13, 10};
    const double origin[3] = {-4, -2.7, -2}, spacing = 0.45;
    const auto fill = [&](auto&& field) {
        std::vector<float> c;
        for (int k = 0; k < size[2]; ++k)
            for (int j = 0; j < size[1]; ++j)
                for (int i = 0; i < size[0]; ++i) c.push_back(float(field(origin[0] + spacing * i, origin[1] + spacing * j, origin[2] + spacing * k)));
        return c;
    };
    const auto quadratic = fill([](double x, double y, double z) { return 0.3 + 0.1 * x * y - 0.2 * z * z + 0.05 * x * x - 0.3 * y; });
    for (const int factor : {2, 3}) {
        const LumenMap map = make_lumen_map(quadratic.data(), size, origin, spacing, 1e9, 1e9);
        const LumenMap finer = refined_lumen_map(quadratic.data(), size, origin, spacing, factor, {}, 1e9, 1e9);
        const Lumen as_was = view(map, InPlace{}), refined = view(finer, InPlace{});
        for (int trial = 0; trial < 200; ++trial) {
            const Vec3<double> x{uniform(-3, 4), uniform(-1.7, 1.7), uniform(-1, 1)};
            const Distance<double> d = distance_to_wall<double>(refined, x), was = distance_to_wall<double>(as_was, x);
            expect_near(d.value, was.value, 1e-5, "a finer grid keeps a quadratic field");
            expect_near(d.gradient.x, was.gradient.x, 1e-4, "a finer grid keeps a quadratic field's slope");
        }
    }
    constexpr double kRadius = 0.9;
    const auto tube = fill([](double, double y, double z) { return kRadius - std::hypot(y, z); });
    const auto coefficients = spline_coefficients(tube.data(), size);
    const std::vector<InscribedSpheres> spheres{{{-6, 0, 0}, {0, 0, 0}, kRadius, kRadius}, {{0, 0, 0}, {6, 0, 0}, kRadius, kRadius}};
    const LumenMap map = make_lumen_map(coefficients.data(), size, origin, spacing, 1e9, 0.5);
    const LumenMap finer = refined_lumen_map(coefficients.data(), size, origin, spacing, 3, spheres, 1e9, 0.5);
    const LumenMap sparse_map = refined_lumen_map(coefficients.data(), size, origin, spacing, 3, spheres, 0.3, 0.5);
    const Lumen as_was = view(map, InPlace{}), refined = view(finer, InPlace{}), sparse = view(sparse_map, InPlace{});
    expect(bytes(sparse_map) <= bytes(finer), "bricks deep inside are left out");
    expect(distance_to_wall<double>(as_was, {0.3, 0, 0}).value < kRadius - 0.08, "the coarse spline rounds the axis off");
    for (int trial = 0; trial < 500; ++trial) {
        const double rho = uniform(0, 1.3), angle = uniform(0, 6.28);
        const Vec3<double> x{uniform(-3, 4), rho * std::cos(angle), rho * std::sin(angle)};
        const double d = distance_to_wall<double>(refined, x).value;
        // the fine spline errs by half of its own step at most on the axis, and beside it by what the coarse one does
        expect_near(d, kRadius - rho, rho < 0.3 ? 0.5 * spacing / 3 : 0.1 * spacing, "distance in a tube on a finer grid");
        const double there = distance_to_wall<double>(sparse, x).value;
        expect(there == d || (there == sparse.clearance && d >= there), "bricks that are left out change no others, and lie no nearer to the wall");
    }
}

void test_map_borders() {
    const LumenMap map = make_map(1e9), sparse_map = make_map(-10.0);
    const Lumen lumen = view(map, InPlace{}), sparse = view(sparse_map, InPlace{});
    const double nan = std::numeric_limits<double>::quiet_NaN(), far = 1e300;
    for (const double bad : {nan, far, -far, 1e6, -2.6, std::numeric_limits<double>::infinity()})
        for (int axis = 0; axis < 3; ++axis) {
            Vec3<double> x{1.0, 0.0, 0.0};
            (axis == 0 ? x.x : axis == 1 ? x.y : x.z) = bad == -2.6 && axis != 0 ? -9.0 : bad;
            expect(std::isnan(distance_to_wall<double>(lumen, x).value), "outside the map the distance is NaN");
        }
    for (int trial = 0; trial < 2000; ++trial) {  // the sanitizers watch the stencil of cells at the border
        const Vec3<double> x{uniform(-3, 14), uniform(-5, 9), uniform(-4, 8)};
        const double d = distance_to_wall<double>(lumen, x).value;
        expect(std::isnan(d) || std::abs(d) < 10, "the distance is finite or NaN");
    }
    expect_near(distance_to_wall<double>(sparse, {1, 0, 0}).value, -10.0, 0, "cells without wall are as far from it as left out");
    expect(bytes(sparse_map) < bytes(map), "bricks away from the wall are not kept");
}

void test_wall() {
    const LumenMap map = make_map(1e9);
    const Lumen lumen = view(map, InPlace{});
    const double stiffness = 5.0, radius = 0.9;  // touches in part of the map
    int touching = 0, clear = 0;
    for (int trial = 0; trial < 800; ++trial) {
        const WallSpring spring{stiffness, trial % 2 ? 0.7 : 0.0};
        const Pose poses[2] = {{{uniform(-1.5, 7), uniform(-3.5, 4), uniform(-2.5, 2.5)}, {1, {0, 0, 0}}}, {}};
        const auto energy = [&](const Vec3<double>& x) { return wall_energy(lumen, spring, radius, x).energy; };
        const Block exact = wall_energy(lumen, spring, radius, poses[0].x);
        const double depth = radius - distance_to_wall<double>(lumen, poses[0].x).value;
        const double yields = trial % 2 ? (std::exp(0.7 * depth * depth) - 1) / 1.4 : 0.5 * depth * depth;
        expect_near(exact.energy, depth > 0 ? stiffness * yields : 0.0, 1e-12, "energy of the wall");
        (depth > 0 ? touching : clear)++;
        if (std::abs(depth) < 1e-2) continue;
        const double h = 1e-5, place[3] = {poses[0].x.x + 2.0, poses[0].x.y + 4.0, poses[0].x.z + 3.0};
        for (int a = 0; a < 3; ++a) {
            const Vec3<double> up = moved(poses[0], a, h).x, down = moved(poses[0], a, -h).x;
            expect_near(exact.gradient[a], (energy(up) - energy(down)) / (2 * h), 1e-7, "gradient of the wall");
            const double cell = place[a] / kSpacing + 0.5;
            if (std::abs(cell - std::round(cell)) < 1e-3) continue;
            const Block above = wall_energy(lumen, spring, radius, up), below = wall_energy(lumen, spring, radius, down);
            for (int b = 0; b < 3; ++b)
                expect_near(exact.hessian[a][b], (above.gradient[b] - below.gradient[b]) / (2 * h), 1e-6, "Hessian of the wall");
        }
    }
    expect(touching > 50 && clear > 50, "the test sees nodes that touch and nodes that do not");
}

void test_friction() {
    for (int trial = 0; trial < 50; ++trial) {
        const Quaternion<double> start_q = random_rotation<double>();
        const Vec3<double> axis = frame(start_q).d3, other = frame(random_rotation<double>()).d1;
        Vec3<double> n = cross(axis, other);
        n = (1 / std::sqrt(dot(n, n))) * n;  // the wall's normal, square to the wire
        const double limit = 0.7, eps = 0.02, radius = 0.18;
        const FrictionState<double> friction{limit, n, radius * cross(n, axis)};
        const Vec3<double> start{0.1, -0.2, 0.3};
        const Pose now{start + Vec3<double>{uniform(-.1, .1), uniform(-.1, .1), uniform(-.1, .1)},
                       rotated(start_q, {uniform(-.1, .1), uniform(-.1, .1), uniform(-.3, .3)})};
        const Block exact = friction_energy(friction, eps, start, start_q, now);
        const double force = std::hypot(exact.gradient[0], exact.gradient[1], exact.gradient[2]);
        expect(force <= limit * (1 + 1e-12), "friction is at most its limit");
        expect_near(exact.gradient[0] * n.x + exact.gradient[1] * n.y + exact.gradient[2] * n.z, 0, 1e-14, "friction acts along the wall");
        const double h = 1e-5;
        for (int a = 0; a < 6; ++a) {
            const Block up = friction_energy(friction, eps, start, start_q, moved(now, a, h));
            const Block down = friction_energy(friction, eps, start, start_q, moved(now, a, -h));
            expect_near(exact.gradient[a], (up.energy - down.energy) / (2 * h), 1e-7, "gradient of friction");
            for (int b = 0; b < 3; ++b)  // the rows of rotations leave out the second derivative of the turn
                expect_near(exact.hessian[a][b], (up.gradient[b] - down.gradient[b]) / (2 * h), 1e-5, "Hessian of friction");
        }
        const Block secant = friction_energy(friction, eps, start, start_q, now, 0.0);
        expect(secant.energy == exact.energy && secant.gradient == exact.gradient, "the secant changes the Hessian alone");
        double harder = 0;  // v · (secant - tangent) v, for the step that the slip has made
        const Vec3<double> made = now.x - start;
        const double v[6] = {made.x, made.y, made.z, 0, 0, 0};
        for (int a = 0; a < 6; ++a)
            for (int b = 0; b < 6; ++b) harder += v[a] * (secant.hessian[a][b] - exact.hessian[a][b]) * v[b];
        expect(harder > 0, "friction's secant is harder than its tangent");
        const Block still = friction_energy(friction, eps, start, start_q, {start, start_q});
        expect_near(still.energy, 0, 1e-16, "friction at rest holds no energy");
    }
}

// A quarter of a circle of 20 mm about the y axis, from the ostium along x, in a lumen that narrows from 2 to 1 mm; at its
// middle a branch of 1.5 mm leaves straight along its tangent. In polar coordinates the projection is exact but for the chords.
void test_projection() {
    constexpr int n = 65, middle = 32, straight = 21;
    constexpr double R = 20.0, quarter = 1.5707963267948966;
    const auto arc = [&](double angle, double radius) {
        return Vec3<double>{radius * std::sin(angle), 0.0, R - radius * std::cos(angle)};
    };
    const auto along = [&](double angle) { return Vec3<double>{std::cos(angle), 0.0, std::sin(angle)}; };
    std::vector<Vertex> vertex;
    for (int i = 0; i < n; ++i) {
        const double share = double(i) / (n - 1), angle = quarter * share;
        vertex.push_back({arc(angle, R), along(angle), R * angle, 2.0 - share, 0, n - 1, 0});
    }
    const Vec3<double> fork = vertex[middle].point, onwards = vertex[middle].tangent;
    for (int i = 0; i < straight; ++i)
        vertex.push_back({fork + (0.5 * i) * onwards, onwards, vertex[middle].abscissa + 0.5 * i, 1.5, n, n + straight - 1, 1});
    constexpr double never = std::numeric_limits<double>::infinity();
    std::vector<Candidate> candidate(2 * vertex.size(), {never, 0});
    for (int i = 0; i < n; ++i) candidate[2 * i + 1] = {0.0, n + std::clamp(2 * (i - middle), 0, straight - 1)};
    for (int i = 0; i < straight; ++i) candidate[2 * (n + i)] = {0.0, std::min(middle + i, n - 1)};
    const Projector project(vertex, candidate, {{0, 0, 0}, {1, 0, 0}, 2.0});
    const auto nearest = [&](const Vec3<double>& point) {
        std::pair<double, std::int64_t> best{never, 0};
        for (std::size_t v = 0; v < vertex.size(); ++v) {
            const Vec3<double> off = point - vertex[v].point;
            best = std::min(best, {std::sqrt(dot(off, off)), std::int64_t(v)});
        }
        return best;
    };
    for (int trial = 0; trial < 200; ++trial) {
        const double angle = uniform(0.05, 0.45) * quarter, inwards = uniform(-1, 1), aside = uniform(-1, 1);
        Vec3<double> point = arc(angle, R + inwards);
        point.y = aside;
        const auto [distance, start] = nearest(point);
        const Projected found = project(point, start, distance);
        expect(found.branch == 0, "before the fork a point lies in the parent");
        expect_near(found.abscissa, R * angle, 2e-3, "abscissa along a circle");
        expect_near(found.offset, std::hypot(inwards, aside), 4e-3, "offset from a circle");
        expect_near(found.radius, 2.0 - angle / quarter, 1e-3, "radius of a lumen that narrows");
    }
    for (double ahead : {4.0, 7.3, 9.9, 12.0}) {  // the last beyond the branch's end: its last plane
        const Vec3<double> point = fork + ahead * onwards;
        const auto [distance, start] = nearest(point);
        const Projected found = project(point, start, distance);
        expect(found.branch == 1, "a point in the branch lies there");
        expect_near(found.abscissa, vertex[middle].abscissa + std::min(ahead, 10.0), 1e-9, "abscissa along a branch");
        expect_near(found.offset, std::max(ahead - 10.0, 0.0), 1e-9, "offset from a branch");
    }
    const Vec3<double> behind{-3.0, 0.5, 0.0};
    const auto [distance, start] = nearest(behind);
    const Projected found = project(behind, start, distance);
    expect_near(found.abscissa, -3.0, 1e-12, "abscissa behind the ostium");
    expect_near(found.offset, 0.5, 1e-12, "offset from the catheter's axis");
    expect_near(found.radius, 2.0, 1e-12, "radius behind the ostium");
}

}  // namespace

int main() {
    test_lanes<double>();
    test_lanes<double4>();
    test_lanes<double8>();
    test_solver<double>();
    test_solver<double4>();
    test_solver<double8>();
    test_elastic_energy(0.3, 1.0, 0.0);
    test_elastic_energy(0.02, 0.0, 1e-3);
    test_elastic_energy(0.3, 1.0, 0.0, 0.2);
    test_elastic_energy(0.02, 0.0, 5e-3, 0.2);
    test_elastic_energy(0.02, 1.0, 2e-2);
    test_gauss_newton();
    test_distance<double>();
    test_distance<double4>();
    test_spline_coefficients();
    test_refined_map();
    test_map_borders();
    test_wall();
    test_friction();
    test_projection();
    test_stiff_chain();
    test_middle();
    std::printf(failures == 0 ? "all core tests passed\n" : "%d core checks failed\n", failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
