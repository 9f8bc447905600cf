// Cairn for C++17: cairn.h with owners and exceptions. Nothing to link but libcairn.so. Licence: MIT OR Apache-2.0.
#ifndef CAIRN_HPP
#define CAIRN_HPP

#include <chrono>
#include <cstring>
#include <locale>
#include <memory>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>

#include "cairn.h"

namespace cairn {

using Duration = std::chrono::nanoseconds;
using Pose = cairn_pose;
using Health = cairn_health;
using Landmark = cairn_landmark;
using Obstacles = cairn_obstacles;
using Tags = cairn_tags;

// Waiting would not cure it; what() names reason and cure.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

namespace detail {
inline std::uint64_t ns(Duration time) { return time.count() > 0 ? static_cast<std::uint64_t>(time.count()) : 0; }

inline bool came(int outcome) {
    if (outcome == CAIRN_ERROR)
        throw Error(cairn_error());
    return outcome == CAIRN_MESSAGE;
}

// A view of shared memory that is given back at its end. Two of a kind may be held at a time.
template <typename View, void (*RELEASE)(View *)> class Held {
  public:
    explicit Held(View view) : view_(view) {}
    Held(Held &&other) noexcept : view_(std::exchange(other.view_, View{})) {}
    Held &operator=(Held &&other) noexcept {
        std::swap(view_, other.view_);
        return *this;
    }
    Held(const Held &) = delete;
    Held &operator=(const Held &) = delete;
    ~Held() { RELEASE(&view_); }
    const View *operator->() const { return &view_; }
    const View &operator*() const { return view_; }

  private:
    View view_;
};
} // namespace detail

// A map: header, landmarks, count.
struct Map : detail::Held<cairn_map, cairn_map_release> {
    using Held::Held;
    const Landmark *begin() const { return (*this)->landmarks; }
    const Landmark *end() const { return (*this)->landmarks + (*this)->count; }
};
// Keyframes: header, keyframes, count.
struct Keyframes : detail::Held<cairn_keyframes, cairn_keyframes_release> {
    using Held::Held;
    const cairn_keyframe *begin() const { return (*this)->keyframes; }
    const cairn_keyframe *end() const { return (*this)->keyframes + (*this)->count; }
};
// What holds the map together: header, edges, count.
struct Graph : detail::Held<cairn_graph, cairn_graph_release> {
    using Held::Held;
    const cairn_graph_edge *begin() const { return (*this)->edges; }
    const cairn_graph_edge *end() const { return (*this)->edges + (*this)->count; }
};
// A grey picture: header, pixels, size.
using Frame = detail::Held<cairn_frame, cairn_frame_release>;

// What was found in a picture: header, features, count.
struct Features : detail::Held<cairn_features, cairn_features_release> {
    using Held::Held;
    const cairn_feature *begin() const { return (*this)->features; }
    const cairn_feature *end() const { return (*this)->features + (*this)->count; }
};

// The robot may act on this pose: tracked, and its frame is no older than max_age.
inline bool usable(const Pose &pose, Duration max_age) {
    return cairn_pose_is_usable(&pose, detail::ns(max_age)) != 0;
}

// Angle about the vertical in odom, counter-clockwise from above, rad; also before there is a map. No leave to drive: see usable().
inline std::optional<double> heading(const Pose &pose) {
    double angle = 0.0;
    return cairn_pose_heading(&pose, &angle) != 0 ? std::optional(angle) : std::nullopt;
}

// A connection to one daemon, which need not run yet. One thread at a time.
class Client {
  public:
    // Without a prefix: what CAIRN_PREFIX names, or "cairn".
    explicit Client(const char *prefix = nullptr) : client_(cairn_connect(prefix)) {
        if (cairn_abi_version() != CAIRN_ABI_VERSION)
            throw Error("libcairn.so and cairn.h are of different versions");
        if (!client_)
            throw Error(cairn_error());
    }

    // Every pose in order; empty when none has come in that time.
    std::optional<Pose> pose(Duration timeout) {
        Pose pose;
        return detail::came(cairn_pose_wait(client_.get(), detail::ns(timeout), &pose)) ? std::optional(pose) : std::nullopt;
    }
    // The newest pose there is, the same one again while no newer has come.
    std::optional<Pose> latest_pose() {
        Pose pose;
        return detail::came(cairn_pose_latest(client_.get(), &pose)) ? std::optional(pose) : std::nullopt;
    }
    std::optional<Health> health(Duration timeout) {
        Health health;
        return detail::came(cairn_health_wait(client_.get(), detail::ns(timeout), &health)) ? std::optional(health)
                                                                                           : std::nullopt;
    }
    // The next map that was not read yet, where it lies in shared memory.
    std::optional<Map> map(Duration timeout) { return view<Map>(cairn_map_wait, timeout); }
    std::optional<Keyframes> keyframes(Duration timeout) { return view<Keyframes>(cairn_keyframes_wait, timeout); }
    std::optional<Graph> graph(Duration timeout) { return view<Graph>(cairn_graph_wait, timeout); }
    std::optional<Frame> frame(Duration timeout) { return view<Frame>(cairn_frame_wait, timeout); }
    std::optional<Features> features(Duration timeout) { return view<Features>(cairn_features_wait, timeout); }

    // The newest scan of what stands around the robot; made only while it is asked for. NaN and 0 are unknown, never free.
    std::optional<Obstacles> obstacles(Duration timeout) {
        Obstacles scan;
        return detail::came(cairn_obstacles_wait(client_.get(), detail::ns(timeout), &scan)) ? std::optional(scan)
                                                                                            : std::nullopt;
    }

    // Where the map's tags are (`count` of `tags`); told with every map, only while it is asked for. NaN is not placed yet.
    std::optional<Tags> tags(Duration timeout) {
        Tags tags;
        return detail::came(cairn_tags_wait(client_.get(), detail::ns(timeout), &tags)) ? std::optional(tags) : std::nullopt;
    }

    // For the driver of the robot's base: its mean twist since the last call, up to now (forward, to the left, turn to the left), 20 to 100
    // times a second. True if a daemon is there; throws where another driver tells of the wheels already. Never waits.
    bool send_wheels(double linear_x_mps, double linear_y_mps, double angular_z_radps) {
        return detail::came(cairn_wheel_send(client_.get(), linear_x_mps, linear_y_mps, angular_z_radps));
    }
    // With stamps and variances of the driver's own.
    bool publish_wheels(const cairn_wheel_odometry &message) {
        return detail::came(cairn_wheel_publish(client_.get(), &message));
    }

    // Throws only if there is no answer; a refusal is an answer.
    cairn_command_reply command(const cairn_command &command, Duration timeout) {
        cairn_command_reply reply;
        detail::came(cairn_send_command(client_.get(), &command, detail::ns(timeout), &reply));
        return reply;
    }
    // A command on stored maps: CAIRN_COMMAND_LOAD_MAP, _STORE_MAP, _NEW_MAP, _MERGE_MAP, _LIST_MAPS and _COPY_MAP with a map's name (or nothing),
    // CAIRN_COMMAND_LOCALISE with "on" or "off".
    cairn_command_reply map_command(std::uint32_t kind, std::string_view name, Duration timeout) {
        return text_command(kind, name, timeout);
    }

    // A line for each control of the camera: NAME UNIT LOWEST HIGHEST STEP DEFAULT VALUE, and auto, manual or manual-only (src/messages/WIRE.md).
    cairn_command_reply camera_controls(Duration timeout) { return text_command(CAIRN_COMMAND_CAMERA_CONTROLS, "", timeout); }
    // exposure (ms), gain or focus (the camera's own steps); without a value the camera decides.
    cairn_command_reply set_camera(const std::string &control, std::optional<double> value, Duration timeout) {
        return text_command(CAIRN_COMMAND_SET_CAMERA, control + " " + (value ? number(*value) : "auto"), timeout);
    }
    // Which camera it is: its identity, as calibrations are found by, a space, and its device file.
    cairn_command_reply camera_identity(Duration timeout) { return text_command(CAIRN_COMMAND_CAMERA_IDENTITY, "", timeout); }
    // Has the daemon keep a calibration file, which it must be able to read, for its camera; it is used from the next reset or start on.
    cairn_command_reply keep_calibration(std::string_view path, Duration timeout) {
        return text_command(CAIRN_COMMAND_KEEP_CALIBRATION, path, timeout);
    }

    cairn_command_reply reset(Duration timeout) {
        cairn_command what{};
        what.kind = CAIRN_COMMAND_RESET;
        return command(what, timeout);
    }

  private:
    cairn_command_reply text_command(std::uint32_t kind, std::string_view text, Duration timeout) {
        cairn_command what{};
        what.kind = kind;
        if (text.size() > sizeof what.path)
            throw Error("the text of a command is too long");
        std::memcpy(what.path, text.data(), text.size());
        what.path_len = static_cast<std::uint32_t>(text.size());
        return command(what, timeout);
    }
    // Whatever the program's locale calls a decimal point.
    static std::string number(double value) {
        std::ostringstream text;
        text.imbue(std::locale::classic());
        text << value;
        return text.str();
    }
    template <typename Owner, typename View>
    std::optional<Owner> view(std::int32_t (*wait)(cairn_client *, std::uint64_t, View *), Duration timeout) {
        View view{};
        if (!detail::came(wait(client_.get(), detail::ns(timeout), &view)))
            return std::nullopt;
        return std::optional<Owner>(std::in_place, view);
    }

    struct Close {
        void operator()(cairn_client *client) const { cairn_close(client); }
    };
    std::unique_ptr<cairn_client, Close> client_;
};

} // namespace cairn

#endif
