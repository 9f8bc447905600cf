/* A base's driver in C. It may be started before the daemon, and survives the daemon's restarts.
 *
 *     cc -std=c11 -O2 -I clients/c clients/c/wheels.c -L target/release -lcairn -Wl,-rpath,"$PWD/target/release" -o wheels
 *     ./wheels [MESSAGES]                                (CAIRN_PREFIX says which daemon)
 *
 * In C++: cairn::Client client; while (...) client.send_wheels(speed_mps, 0.0, turn_radps); */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "cairn.h"

/* Stands for the robot's own: the mean speed forward, m/s, and turn to the left, rad/s, since the last time. */
static void read_encoders(double *speed_mps, double *turn_radps) {
    const struct timespec period = {0, 20000000};
    nanosleep(&period, NULL);
    *speed_mps = 0.3;
    *turn_radps = 0.1;
}

int main(int count, char **words) {
    long left = count > 1 ? strtol(words[1], NULL, 10) : -1;
    double speed_mps, turn_radps;
    cairn_client *client = cairn_connect(NULL);
    while (client && left != 0) {
        read_encoders(&speed_mps, &turn_radps);
        if (cairn_wheel_send(client, speed_mps, 0.0, turn_radps) == CAIRN_ERROR)
            break;
        left -= left > 0;
    }
    if (left != 0)
        fprintf(stderr, "%s\n", cairn_error());
    cairn_close(client);
    return left != 0;
}
