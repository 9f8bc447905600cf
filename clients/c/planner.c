/* A planner in C. It may be started before the daemon, and survives the daemon's restarts.
 *
 *     cargo rustc --release --lib --crate-type cdylib --no-default-features --features c
 *     cc -std=c11 -O2 -I clients/c clients/c/planner.c -L target/release -lcairn -Wl,-rpath,"$PWD/target/release" -o planner
 *     ./planner [POSES]                                  (CAIRN_PREFIX says which daemon)
 */
#include <stdio.h>
#include <stdlib.h>

#include "cairn.h"

static const char *const STATES[] = {"INITIALIZING", "TRACKING", "LOST", "ORIENTATION", "DEAD_RECKONING"};

int main(int count, char **words) {
    long left = count > 1 ? strtol(words[1], NULL, 10) : -1;
    if (cairn_abi_version() != CAIRN_ABI_VERSION) {
        fprintf(stderr, "libcairn.so is of version %u, this program of %u\n", cairn_abi_version(), CAIRN_ABI_VERSION);
        return 1;
    }
    cairn_client *client = cairn_connect(NULL);
    if (!client) {
        fprintf(stderr, "%s\n", cairn_error());
        return 1;
    }
    cairn_pose pose;
    cairn_map map;
    int outcome = CAIRN_NOTHING;
    while (left != 0 && (outcome = cairn_pose_wait(client, 1000000000, &pose)) != CAIRN_ERROR) {
        if (outcome == CAIRN_NOTHING) {
            fprintf(stderr, "no pose for a second: stop\n");
            continue;
        }
        /* Only a pose that was tracked, and just now, may steer a robot. Metres only where `scale` says so. */
        int usable = cairn_pose_is_usable(&pose, 200000000);
        printf("%llu %s x %.3f y %.3f z %.3f -> %s\n", (unsigned long long)pose.sequence,
               pose.state < sizeof STATES / sizeof *STATES ? STATES[pose.state] : "UNKNOWN", pose.position[0], pose.position[1], pose.position[2],
               usable ? "drive" : "stop");
        double heading;
        if (!usable && cairn_pose_heading(&pose, &heading))
            printf("heading %.1f degrees since the first picture\n", heading * 57.29577951308232);
        /* A map comes twice a second; it is read where it lies. */
        if (cairn_map_wait(client, 0, &map) == CAIRN_MESSAGE) {
            double ahead = 0.0;
            for (size_t i = 0; i < map.count; i++)
                ahead += map.landmarks[i].position[0];
            printf("map %u content %llu: %zu landmarks, mean x %.3f\n", map.header->map_id,
                   (unsigned long long)map.header->content_revision, map.count, map.count ? ahead / (double)map.count : 0.0);
            cairn_map_release(&map);
        }
        left -= left > 0;
    }
    if (outcome == CAIRN_ERROR)
        fprintf(stderr, "%s\n", cairn_error());
    cairn_close(client);
    return outcome == CAIRN_ERROR;
}
