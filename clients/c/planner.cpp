// A planner in C++17: drives while it knows where it is, and looks for mapped points in its way.
//
//     cargo rustc --release --lib --crate-type cdylib --no-default-features --features c
//     c++ -std=c++17 -O2 -I clients/c clients/c/planner.cpp -L target/release -lcairn -Wl,-rpath,"$PWD/target/release" -o planner
//     ./planner [POSES]                                  (CAIRN_PREFIX says which daemon)
#include <cmath>
#include <cstdlib>
#include <iostream>

#include "cairn.hpp"

using namespace std::chrono_literals;

// Mapped points within half a unit of the robot's way, up to two units ahead, and off the ground.
static std::size_t in_the_way(const cairn::Pose &pose, const cairn::Map &map) {
    const double x = pose.orientation[0], y = pose.orientation[1], z = pose.orientation[2], w = pose.orientation[3];
    const double yaw = std::atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    std::size_t found = 0;
    for (const cairn::Landmark &landmark : map) {
        const double dx = landmark.position[0] - pose.position[0], dy = landmark.position[1] - pose.position[1];
        const double ahead = std::cos(yaw) * dx + std::sin(yaw) * dy, aside = std::cos(yaw) * dy - std::sin(yaw) * dx;
        found += ahead > 0 && ahead < 2 && std::fabs(aside) < 0.5 && landmark.observations >= 3;
    }
    return found;
}

int main(int count, char **words) try {
    long left = count > 1 ? std::strtol(words[1], nullptr, 10) : -1;
    cairn::Client client;
    std::optional<cairn::Map> map;
    while (left != 0) {
        const auto pose = client.pose(1s);
        if (auto newer = client.map(0s))
            map = std::move(newer);
        if (!pose || !cairn::usable(*pose, 200ms)) {
            std::cout << "stop";
            if (const auto heading = pose ? cairn::heading(*pose) : std::nullopt)
                std::cout << ", turned by " << *heading << " rad";
            std::cout << std::endl;
        } else {
            const auto obstacles = map ? in_the_way(*pose, *map) : 0;
            std::cout << pose->sequence << (obstacles > 20 ? " turn" : " drive") << ", points ahead " << obstacles << std::endl;
        }
        left -= left > 0 && pose;
    }
} catch (const cairn::Error &error) {
    std::cerr << error.what() << std::endl;
    return 1;
}
