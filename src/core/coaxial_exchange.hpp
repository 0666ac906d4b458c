// Tubes between lanes and worlds: loaded, given their controls, brought to the end of a sample, stored and recorded.
#pragma once

#include "exchange.hpp"

namespace endopilot {

template <class V, int T>
void Stepper<V, T>::load_tubes(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    double pushed = 0;
    lane.tubes.lead = 0;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        const World::Numbers from = w.tube(rod_.nodes, k);
        tube = {};
        tube.inserted = tube.advanced = from[World::kTubeInserted];
        tube.rotation = tube.turned = tube.end_rotation = from[World::kTubeRotation];
        tube.last_rotation = from[World::kTubeLastTurned];
        tube.slipping = int(from[World::kTubeSlipping]);
        tube.depth = from[World::kTubeDepth];
        tube.pace = from[World::kTubePace];
        tube.yield = from[World::kTubeYield];
        tube.grip = from[World::kTubeGrip];
        tube.force = from[World::kTubeBaseForce];
        tube.torque = from[World::kTubeBaseTorque];
        pushed += tube.force;
        if (from[World::kTubeLeads] != 0) lane.tubes.lead = k;
        set(of_tubes_.friction[k], l, from[World::kTubeFriction]);
    }
    lane.tubes.others = pushed - lane.tubes.tube[lane.tubes.lead].force;
}

template <class V, int T>
void Stepper<V, T>::store_tubes(int l) {
    const Lane& lane = lane_[l];
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeInserted] = tube.inserted;
        to[World::kTubeRotation] = tube.rotation;
        to[World::kTubeSpeed] = tube.speed;
        to[World::kTubeSpin] = tube.spin;
        to[World::kTubeLastTurned] = k == 0 ? lane.last.rotation : tube.last_rotation;
        to[World::kTubeSlipping] = tube.slipping;
        to[World::kTubeDepth] = tube.depth;
        to[World::kTubePace] = tube.pace;
        to[World::kTubeYield] = tube.yield;
        to[World::kTubeGrip] = tube.grip;
        to[World::kTubeLeads] = k == lane.tubes.lead;
        to[World::kTubeBaseForce] = tube.force;
        to[World::kTubeBaseTorque] = tube.torque;
    }
}

template <class V, int T>
void Stepper<V, T>::read_tube_controls(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    bool same = true;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        if (lane.sample < 0) {
            tube.speed = lane.sample == -1 ? 0.0 : (tube.depth - tube.inserted) / ((-lane.sample - 1) * sample_period());
            tube.spin = 0.0;
        } else {
            const double* control = in_.control + 2 * (T + 1) * (std::size_t(lane.world) * in_.samples + lane.sample) + 2 * k;
            tube.speed = control[0];
            tube.spin = control[1];
        }
        if (tube.inserted + tube.speed * sample_period() < -kOvershoot) {
            tube.refused = tube.inserted + tube.speed * sample_period();
            tube.speed = -tube.inserted / sample_period();
        }
        const World::Numbers was = w.tube(rod_.nodes, k);
        same = same && tube.speed == was[World::kTubeSpeed] && tube.spin == was[World::kTubeSpin];
    }
    if (!same) lane.last_duration = 0;  // do not extrapolate
}

// Where the sample has brought the tubes, and the loads of their drives.
template <class V, int T>
void Stepper<V, T>::end_tubes(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        tube.inserted += tube.speed * sample_period() - tube.slipped;
        tube.rotation += tube.spin * sample_period() - tube.rotation_slipped;
        if (lane.sample < 0) {
            tube.depth -= tube.slipped;
            if (lane.sample == -1) tube.inserted = tube.depth;  // exactly
        }
        const DriveEnergy valve = introducer({tube.end_advance - tube.advanced, tube.last_rotation}, tubes_.radius[k], l);
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeDriveForce] = tube.force + valve.gradient_a;
        to[World::kTubeDriveTorque] = tube.torque + valve.gradient_r;
        lane.inserted = k == 0 ? tube.inserted : std::max(lane.inserted, tube.inserted);
    }
    const Tube& first = lane.tubes.tube[0];
    if (lane.sample < 0) {
        out_.approach_slip[2 * lane.world] += first.slipped;
        out_.approach_slip[2 * lane.world + 1] += first.rotation_slipped;
        w[World::kApproach] = -lane.sample - 1;
    }
    lane.rotation = first.rotation;
    lane.refused = first.refused;
    lane.slip = {first.slipped, first.rotation_slipped};
    w[World::kBaseForce] = first.force;
    w[World::kBaseTorque] = first.torque;
    w[World::kDriveForce] = w.tube(rod_.nodes, 0)[World::kTubeDriveForce];
    w[World::kDriveTorque] = w.tube(rod_.nodes, 0)[World::kTubeDriveTorque];
    for (int k = 0; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeSlip] = tube.slipped + tube.refused;
        to[World::kTubeRotationSlip] = tube.rotation_slipped;
    }
}

template <class V, int T>
void Stepper<V, T>::record_tubes(int world, int sample) const {
    const World w = world_[world];
    const std::size_t at = std::size_t(world) * in_.samples + sample;
    const Pose pose(rod_, base_, motion_, w);
    out_.inserted[at] = w.tube(rod_.nodes, 0)[World::kTubeInserted];
    for (int k = 0; k <= T; ++k) {
        const World::Numbers from = w.tube(rod_.nodes, k);
        double* to = out_.tubes + (at * (T + 1) + k) * kTubeOutputs;
        to[0] = from[World::kTubeInserted];
        to[1] = from[World::kTubeRotation];
        to[2] = from[World::kTubeBaseForce];
        to[3] = from[World::kTubeBaseTorque];
        to[4] = from[World::kTubeDriveForce];
        to[5] = from[World::kTubeDriveTorque];
        to[6] = from[World::kTubeSlip];
        to[7] = from[World::kTubeRotationSlip];
        const Vec3<double> tip = pose.tube_tip(k);
        const int i = tube_end(rod_, w, k).element;
        to[8] = tip.x, to[9] = tip.y, to[10] = tip.z;
        to[11] = 0;
        if (k > 0) to[11] = i < w.active() ? w.twists(rod_.nodes, T, i)[k - 1] : to[1] - w[World::kRotation];
    }
}

}  // namespace endopilot
