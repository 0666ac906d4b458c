// Tests of the core's telescoping tubes: the energy of a joint against finite differences, the block solver with further unknowns
// against a dense product, joints that a tube's end passes, and drives at their bounds.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <string>
#include <vector>

#include "bounds.hpp"
#include "solve.hpp"
#include "tubes.hpp"

using namespace endopilot;

namespace {

int failures = 0;
std::mt19937_64 generator(11);

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

// The unknowns of an element: rotation vector, then the turn of each further tube.
template <int T>
struct Element {
    Quaternion<double> q{1, {0, 0, 0}};
    double twist[T] = {};

    Element moved(int unknown, double h) const {
        Element e = *this;
        Vec3<double> angle{0, 0, 0};
        (unknown == 0 ? angle.x : unknown == 1 ? angle.y : angle.z) = unknown < 3 ? h : 0.0;
        e.q = rotated(q, angle);
        for (int k = 0; k < T; ++k) e.twist[k] += (unknown == 3 + k ? h : 0.0) - angle.z;  // a twist is its tube's turn less theta_3
        return e;
    }
};

template <int T>
struct Pair {
    static constexpr int N = 3 + T;
    double energy, gradient[2][N], own[2][N][N], coupling[N][N];
};

template <int T>
Pair<T> joint_energy(double L, const TubeJoint<double, T>& joint, const Element<T>& distal, const Element<T>& proximal, double geometric,
                     double share) {
    Diagonal<double, T> block[2]{};
    Link<double, T> link{};
    Pair<T> p{};
    p.energy = add_tube_joint<double, T>(L, joint, float(geometric), share, 1 / share, distal.q, proximal.q, distal.twist, proximal.twist,
                                         block[0], block[1], link);
    for (int b = 0; b < 2; ++b) {
        const Diagonal<double, T>& d = block[b];
        const double g[3] = {d.gradient_theta.x, d.gradient_theta.y, d.gradient_theta.z};
        const double tt[3][3] = {{d.tt.xx, d.tt.xy, d.tt.xz}, {d.tt.xy, d.tt.yy, d.tt.yz}, {d.tt.xz, d.tt.yz, d.tt.zz}};
        for (int r = 0; r < 3; ++r) {
            p.gradient[b][r] = g[r];
            for (int c = 0; c < 3; ++c) p.own[b][r][c] = tt[r][c];
        }
        for (int k = 0; k < T; ++k) {
            p.gradient[b][3 + k] = d.twists.gradient[k];
            for (int c = 0; c < 3; ++c) p.own[b][3 + k][c] = p.own[b][c][3 + k] = d.twists.pt[k][c];
            for (int c = 0; c <= k; ++c) p.own[b][3 + k][3 + c] = p.own[b][3 + c][3 + k] = d.twists.pp[k][c];
        }
    }
    for (int r = 0; r < 3 + T; ++r)
        for (int c = 0; c < 3 + T; ++c)
            p.coupling[r][c] = r < 3 ? (c < 3 ? link.tt[r][c] : link.twists.tp[r][c - 3])
                                     : (c < 3 ? link.twists.pt[r - 3][c] : link.twists.pp[r - 3][c - 3]);
    return p;
}

template <int T>
TubeJoint<double, T> random_joint() {
    Integrals ahead[T + 1]{}, behind[T + 1]{};
    for (int k = 0; k <= T; ++k) {
        const double covered = k == T / 2 ? 1.2 : uniform(0.0, 1.2), bend = uniform(1, 3), twist = uniform(1, 3);
        behind[k] = {covered, covered * bend, 1.2 * twist, covered, covered * uniform(-0.3, 0.3)};
    }
    return tube_joint<T>(ahead, behind, 1.2);
}

// As the rod's own joint, the Hessian leaves out the derivatives of g: it holds to the order of strain. Gradients are exact.
template <int T>
void test_joint_energy(double bent, double tolerance, double share) {
    constexpr int N = Pair<T>::N;
    for (int trial = 0; trial < 5; ++trial) {
        const TubeJoint<double, T> joint = random_joint<T>();
        Element<T> e[2];
        e[0].q = rotated(e[0].q, Vec3<double>{uniform(-bent, bent), uniform(-bent, bent), uniform(-bent, bent)});
        for (int k = 0; k < T; ++k) {
            e[1].twist[k] = uniform(-3, 3);
            e[0].twist[k] = e[1].twist[k] + uniform(-bent, bent);
        }
        const auto energy = [&](const Element<T>& a, const Element<T>& b) { return joint_energy<T>(1.2, joint, a, b, 1.0, share).energy; };
        const auto gradient = [&](const Element<T>& a, const Element<T>& b, int block, int unknown) {
            return joint_energy<T>(1.2, joint, a, b, 1.0, share).gradient[block][unknown];
        };
        const Pair<T> exact = joint_energy<T>(1.2, joint, e[0], e[1], 1.0, share);
        for (int block = 0; block < 2; ++block)
            for (int a = 0; a < N; ++a) {
                const double h = 1e-5;
                Element<T> up[2] = {e[0], e[1]}, down[2] = {e[0], e[1]};
                up[block] = e[block].moved(a, h);
                down[block] = e[block].moved(a, -h);
                const std::string at = ", block " + std::to_string(block) + ", unknown " + std::to_string(a) + " of " + std::to_string(N);
                expect_near(exact.gradient[block][a], (energy(up[0], up[1]) - energy(down[0], down[1])) / (2 * h), 1e-8, "gradient" + at);
                for (int b = 0; b < N && tolerance > 0; ++b) {
                    const auto slope = [&](int of) {
                        return (gradient(up[0], up[1], of, b) - gradient(down[0], down[1], of, b)) / (2 * h);
                    };
                    // a gradient turns with its own frame: symmetric parts compare
                    if (block == 0) expect_near(exact.coupling[a][b], slope(1), tolerance, "coupling" + at + "," + std::to_string(b));
                    if (a >= 3 || b >= 3)
                        expect_near(exact.own[block][a][b], slope(block), tolerance, "Hessian" + at + "," + std::to_string(b));
                }
            }
    }
}

// Without its geometric terms the Hessian has no direction of negative curvature.
template <int T>
void test_gauss_newton() {
    constexpr int N = Pair<T>::N;
    for (int trial = 0; trial < 50; ++trial) {
        Element<T> e[2];
        e[0].q = rotated(e[0].q, Vec3<double>{uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)});
        for (int k = 0; k < T; ++k) e[0].twist[k] = uniform(-3, 3), e[1].twist[k] = uniform(-3, 3);
        const Pair<T> gauss = joint_energy<T>(1.2, random_joint<T>(), e[0], e[1], 0.0, 1.0);
        for (int direction = 0; direction < 20; ++direction) {
            double u[2][N], form = 0;
            for (auto& part : u)
                for (double& c : part) c = uniform(-1, 1);
            for (int r = 0; r < N; ++r)
                for (int c = 0; c < N; ++c)
                    form += u[0][r] * gauss.own[0][r][c] * u[0][c] + u[1][r] * gauss.own[1][r][c] * u[1][c] +
                            2 * u[0][r] * gauss.coupling[r][c] * u[1][c];
            expect(form > -1e-4, "the Gauss-Newton Hessian of a joint of tubes has no negative curvature");
        }
    }
}

// A moment that is the same all along a joint bends its covered and its bare stretch in series.
void test_partly_covered_joint() {
    const double length = 1.2, covered = 0.5, wire = 2.0, catheter = 9.0;
    const Integrals none[2]{}, ends[2] = {{length, length * wire, 1, 1, 0.24 * length}, {covered, covered * catheter, 1, 1, 0}};
    const TubeJoint<double, 1> joint = tube_joint<1>(none, ends, length);
    const double f = covered / length;
    expect_near(1 / joint.bend, (1 - f) / wire + f / (wire + catheter), 1e-12, "compliances add");
    expect_near(joint.c[0] + joint.c[1], 1, 1e-12, "shares of the moment add up");
    expect_near(joint.c[0] * joint.rest[0], 0.24 * ((1 - f) + f * wire / (wire + catheter)), 1e-12, "rest curvature");
}

// Solves a chain of random blocks and multiplies back.
template <int T>
void test_solver() {
    constexpr int N = 6 + T, n = 6;
    Diagonal<double, T> own[n]{};
    Link<double, T> link[n]{};
    Factor<double, T> factor[n];
    Carried<double, T> carried{};
    const auto any = [] { return float(uniform(-1, 1)); };
    for (int i = 0; i < n; ++i) {
        own[i].xx = {9, 9, 9, any(), any(), any()};
        own[i].tt = {9, 9, 9, any(), any(), any()};
        own[i].gradient_x = {uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)};
        own[i].gradient_theta = {uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)};
        link[i].uu = {3, 3, 3, 0, 0, 0};
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) own[i].tx[r][c] = any(), link[i].tu[r][c] = any(), link[i].tt[r][c] = any();
        for (int k = 0; k < T; ++k) {
            own[i].twists.gradient[k] = uniform(-1, 1);
            for (int c = 0; c < 3; ++c) {
                own[i].twists.px[k][c] = any(), own[i].twists.pt[k][c] = any();
                link[i].twists.pu[k][c] = any(), link[i].twists.pt[k][c] = any(), link[i].twists.tp[c][k] = any();
            }
            for (int c = 0; c < T; ++c) own[i].twists.pp[k][c] = c == k ? 9.0f : any(), link[i].twists.pp[k][c] = any();
        }
        expect(eliminate(own[i], link[i], carried, factor[i]).smallest_pivot > 0, "pivots are positive");
    }
    std::vector<std::vector<double>> solution(n + 1, std::vector<double>(N, 0.0));  // what follows the last block is held
    Vec3<float> x{0, 0, 0}, t{0, 0, 0};
    float p[T + 1] = {};
    for (int i = n - 1; i >= 0; --i) {
        substitute(factor[i], x, t, p);
        solution[i] = {x.x, x.y, x.z, t.x, t.y, t.z};
        for (int k = 0; k < T; ++k) solution[i].push_back(p[k]);
    }
    // H u + g, with the energy of block i in x_i, its turns, u = x_i - x_{i+1} and the turns of block i + 1
    std::vector<std::vector<double>> left(n + 1, std::vector<double>(N, 0.0));
    const auto full = [](const Sym3<float>& s, int r, int c) {
        const double m[3][3] = {{s.xx, s.xy, s.xz}, {s.xy, s.yy, s.yz}, {s.xz, s.yz, s.zz}};
        return m[r][c];
    };
    for (int i = 0; i < n; ++i) {
        const auto &a = solution[i], &b = solution[i + 1];
        const double g[6] = {own[i].gradient_x.x,     own[i].gradient_x.y,     own[i].gradient_x.z,
                             own[i].gradient_theta.x, own[i].gradient_theta.y, own[i].gradient_theta.z};
        for (int r = 0; r < 6; ++r) left[i][r] += g[r];
        const auto add = [&](int ra, int r, int rb, int c, double h) {   // both triangles
            left[ra][r] += h * solution[rb][c];
            if (ra != rb || r != c) left[rb][c] += h * solution[ra][r];
        };
        const auto add_u = [&](int r, int c, double h) {   // a row of turns, a column of u
            left[i][r] += h * (a[c] - b[c]);
            left[i][c] += h * a[r];
            left[i + 1][c] -= h * a[r];
        };
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) {
                if (c <= r) {
                    add(i, r, i, c, full(own[i].xx, r, c));
                    add(i, 3 + r, i, 3 + c, full(own[i].tt, r, c));
                }
                const double h = full(link[i].uu, r, c) * (a[c] - b[c]);
                left[i][r] += h;
                left[i + 1][r] -= h;
                add(i, 3 + r, i, c, own[i].tx[r][c]);
                add_u(3 + r, c, link[i].tu[r][c]);
                add(i, 3 + r, i + 1, 3 + c, link[i].tt[r][c]);
            }
        for (int k = 0; k < T; ++k) {
            left[i][6 + k] += own[i].twists.gradient[k];
            for (int c = 0; c < 3; ++c) {
                add(i, 6 + k, i, c, own[i].twists.px[k][c]);
                add(i, 6 + k, i, 3 + c, own[i].twists.pt[k][c]);
                add_u(6 + k, c, link[i].twists.pu[k][c]);
                add(i, 6 + k, i + 1, 3 + c, link[i].twists.pt[k][c]);
                add(i, 3 + c, i + 1, 6 + k, link[i].twists.tp[c][k]);
            }
            for (int c = 0; c < T; ++c) {
                if (c <= k) add(i, 6 + k, i, 6 + c, own[i].twists.pp[k][c]);
                add(i, 6 + k, i + 1, 6 + c, link[i].twists.pp[k][c]);
            }
        }
    }
    for (int i = 0; i < n; ++i)
        for (int r = 0; r < N; ++r) expect_near(left[i][r], 0, 2e-5, "residual of block " + std::to_string(i) + ", row " + std::to_string(r));
}

void test_sine_and_cosine() {
    for (double angle = -40; angle < 40; angle += 0.37) {
        double s, c;
        sine_cosine<double>(angle, s, c);
        expect_near(s, std::sin(angle), 1e-13, "sine");
        expect_near(c, std::cos(angle), 1e-13, "cosine");
    }
}

// Karush, Kuhn and Tucker: with q = g + h s, q is 0 where s is free, and points out of the bound where that holds it. Bounds that
// hold one unknown often free another, so that those which Newton's full step would pass are not those that are held.
void test_bounded_minimum() {
    constexpr int N = 4;
    int held_by_bounds = 0, freed = 0;
    for (int trial = 0; trial < 400; ++trial) {
        double root[N][N], h[N][N], g[N], off[N], s[N] = {9e9, 9e9, 9e9, 9e9}, newton[N];
        int side[N];
        const bool none[N] = {};
        for (auto& row : root)
            for (double& each : row) each = uniform(-1, 1);
        for (int r = 0; r < N; ++r) {
            side[r] = int(generator() % 3) - 1;
            off[r] = -side[r] * uniform(0, 0.5);
            g[r] = uniform(-1, 1);
            for (int c = 0; c < N; ++c) {
                h[r][c] = r == c ? 0.02 : 0.0;
                for (int k = 0; k < N; ++k) h[r][c] += root[r][k] * root[c][k];
            }
        }
        expect(solve_with_held(h, g, off, none, newton), "a positive definite matrix");
        expect(bounded_minimum(h, g, side, off, s), "a positive definite matrix");
        for (int r = 0; r < N; ++r) {
            double q = g[r], scale = std::abs(g[r]);
            for (int c = 0; c < N; ++c) q += h[r][c] * s[c], scale += std::abs(h[r][c] * s[c]);
            const double beyond = side[r] * (off[r] + s[r]);
            if (side[r] == 0) {
                expect(s[r] == -off[r], "a drive that holds");
            } else if (beyond == 0) {
                expect(side[r] * q <= 1e-9 * scale, "a bound holds what would pass it");
                ++held_by_bounds;
            } else {
                expect(beyond < 0, "within its bound");
                expect_near(q, 0, 1e-9 * scale, "the gradient where none holds");
                freed += side[r] * (off[r] + newton[r]) > 0;
            }
        }
    }
    expect(held_by_bounds > 100 && freed > 10, "cases that tell");
    const double saddle[2][2] = {{1, 2}, {2, 1}}, g[2] = {}, off[2] = {};
    const int side[2] = {1, 1};
    double s[2];
    expect(!bounded_minimum(saddle, g, side, off, s), "a saddle is told");
}

}  // namespace

int main() {
    test_bounded_minimum();
    test_sine_and_cosine();
    test_partly_covered_joint();
    test_joint_energy<1>(0.3, 0.0, 1.0);
    test_joint_energy<2>(0.3, 0.0, 0.4);
    test_joint_energy<1>(0.01, 2e-2, 1.0);
    test_gauss_newton<1>();
    test_solver<1>();
    std::printf(failures == 0 ? "all core tests passed\n" : "%d core checks failed\n", failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
