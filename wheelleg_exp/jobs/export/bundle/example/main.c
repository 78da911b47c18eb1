/* Run the policy on recorded readings, and print a robot log: policy_example readings.csv > log.csv
 *
 * The first columns of the CSV file are the time (s) and the readings, in the order of policy.json. An empty field is a
 * missing reading. On a robot, read the sensors instead, and call policy_update every POLICY_STEP_US microseconds.
 */
#include "policy.h"
#include <stdio.h>
#include <stdlib.h>

static double field(char **next) {
    char *start = *next, *end;
    double value = strtod(start, &end);
    *next = start + strcspn(start, ",");
    if (**next) ++*next;
    return end == start ? NAN : value;
}

int main(int argc, char **argv) {
    static const char columns[] = "time," POLICY_READING_COLUMNS;
    static char line[1 << 16];
    static policy_guard guard;
    static float values[POLICY_NUMBERS];
    FILE *file = fopen(argc > 1 ? argv[1] : "readings.csv", "r");
    int i, status;
    if (!file) {
        perror(argc > 1 ? argv[1] : "readings.csv");
        return 1;
    }
    if (!fgets(line, sizeof line, file) || strncmp(line, columns, sizeof columns - 1)) {
        fprintf(stderr, "the first line of the file must start with: %s\n", columns);
        return 1;
    }
    printf("%s,%s,status,gain\n", columns, POLICY_TARGET_COLUMNS);
    policy_begin(&guard, 0); /* The recorded robot already stands. A real robot starts up: policy_begin(&guard, 1). */
    while (fgets(line, sizeof line, file)) {
        char *next = line;
        double time = field(&next);
        policy_readings readings;
        policy_targets targets;
        float gain;
        for (i = 0; i < POLICY_NUMBERS; i++) values[i] = (float)field(&next);
        memcpy(&readings, values, sizeof readings);
        status = policy_update(&guard, &readings, llround(1e6 * time), llround(1e6 * time), &targets, &gain);
#if POLICY_HAS_BUMP /* log the commands that the policy got */
        if (guard.phase == POLICY_RUN && guard.jumps_after_bump) {
            memcpy(values + POLICY_BUMP_VELOCITY, guard.policy.bump.command, sizeof guard.policy.bump.command);
            values[POLICY_BUMP_JUMP] = guard.policy.bump.left / POLICY_BUMP_WINDOW_S;
            for (i = 1; i < POLICY_BUMP_NUMBERS; i++)
                values[POLICY_BUMP_JUMP + i] = guard.policy.bump.left > 0.0f ? POLICY_BUMP_HEIGHT : 0.0f;
        }
#endif
        printf("%.6f", time);
        for (i = 0; i < POLICY_NUMBERS; i++) printf(",%.9g", values[i]);
        for (i = 0; i < POLICY_JOINTS; i++) printf(",%.9g", targets.position[i]);
        for (i = 0; i < POLICY_JOINTS; i++) printf(",%.9g", targets.velocity[i]);
        for (i = 0; i < POLICY_JOINTS; i++) printf(",%.9g", targets.effort[i]);
        printf(",%d,%.9g\n", status, gain);
    }
    fclose(file);
    return 0;
}
