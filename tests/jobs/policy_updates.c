#include "policy.h"
#include <stdio.h>
int main(int argc, char **argv) {
    static policy_guard guard;
    struct { int64_t time, now; float quat[4]; policy_readings readings; char end; } in;
    struct { float status, gain, steps; policy_targets targets; } out;
    (void)argv;
    policy_begin(&guard, argc > 1);
    while (fread(&in, (size_t)(&in.end - (char *)&in), 1, stdin)) {
        if (in.quat[0] < 9.0f) policy_projected_gravity(in.quat, in.readings.projected_gravity);
        out.status = (float)policy_update(&guard, &in.readings, in.time, in.now, &out.targets, &out.gain);
        out.steps = (float)guard.policy.steps;
        fwrite(&out, sizeof out, 1, stdout);
    }
    return 0;
}
