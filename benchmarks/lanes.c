// SPDX-License-Identifier: Apache-2.0
// The step of needle_dynamics/compiled/lanes.py in C, with the same arithmetic: two modes, one
// layer of tissue, Coulomb friction, graded steps, one interval of constant force.
#include <math.h>
#include <string.h>

#define LANES 32
#define COLUMNS 26
#define CONSTANTS 19

enum {
    LENGTH, DENSITY, BENDING, STIFFNESS, DAMPING, MASS, COULOMB, VISCOUS, WITHDRAWAL,
    LOW, HIGH, STOP
};

typedef double Row[LANES];

typedef struct {
    Row constant[CONSTANTS];
    Row s, u, a, q1, q2, z1, z2, force, left;
    Row h, rest, xi, xi4, inside, impulse;
    Row new_q1, new_q2, new_z1, new_z2, new_u, travel, stops;
    Row series[COLUMNS];
} Lanes;

static const double ROUND = 6755399441055744.0;  // 1.5 * 2^52

static const double F[] = {
    1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320,
    1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800.0,
    1.0 / 87178291200.0, 1.0 / 1307674368000.0, 1.0 / 20922789888000.0, 1.0 / 355687428096000.0,
    1.0 / 6402373705728000.0, 1.0 / 121645100408832000.0};

static inline double larger(double a, double b) { return a > b ? a : b; }

static inline double smaller(double a, double b) { return a < b ? a : b; }

static inline void sine_cosine(double x, double *sine, double *cosine) {
    double turns = (x * (2.0 / 3.141592653589793) + ROUND) - ROUND;
    double r = x - turns * 1.5707963267341256;
    r = (r - turns * 6.077100506303966e-11) - turns * 2.0222662487959506e-21;
    double y = r * r;
    double sn = F[9] - y * (F[11] - y * (F[13] - y * F[15]));
    sn = r - r * y * (F[3] - y * (F[5] - y * (F[7] - y * sn)));
    double cs = F[10] - y * (F[12] - y * (F[14] - y * F[16]));
    cs = 1.0 - y * (F[2] - y * (F[4] - y * (F[6] - y * (F[8] - y * cs))));
    double quarter = turns - 4.0 * ((0.25 * turns + ROUND) - ROUND);
    double one = fabs(quarter) == 1.0 ? cs : sn, two = fabs(quarter) == 1.0 ? sn : cs;
    *sine = (quarter == -1.0 || fabs(quarter) == 2.0) ? -one : one;
    *cosine = (quarter == 1.0 || fabs(quarter) == 2.0) ? -two : two;
}

static inline void decay_means(double x, double *mean, double *ramp) {
    double z = -(x < 40.0 ? x : 40.0) / 32.0;
    double r = F[14] + z * (F[15] + z * (F[16] + z * (F[17] + z * (F[18] + z * F[19]))));
    r = F[8] + z * (F[9] + z * (F[10] + z * (F[11] + z * (F[12] + z * (F[13] + z * r)))));
    r = F[2] + z * (F[3] + z * (F[4] + z * (F[5] + z * (F[6] + z * (F[7] + z * r)))));
    double m = 1.0 + z * r;
    for (int k = 0; k < 5; k++) {
        r = 0.25 * (m * m + 2.0 * r);
        m *= 1.0 + 0.5 * z * m;
        z *= 2.0;
    }
    double far = 1.0 / (x > 40.0 ? x : 40.0);
    *mean = x > 40.0 ? far : m;
    *ramp = x > 40.0 ? (1.0 - far) * far : r;
}

static void begin(Lanes *w, int n, double longest) {
    for (int i = 0; i < n; i++) {
        double s = w->s[i], u = w->u[i], left = w->left[i], length = w->constant[LENGTH][i];
        double whole = longest * larger(1.0, s / (0.1 * length));
        double count = left / whole * (1.0 - 1e-9);
        double near = (count + ROUND) - ROUND;
        double steps = larger(near < count ? near + 1.0 : near, 1.0);
        double h = left / steps;
        double middle = smaller(s + 0.5 * h * u + h * h * w->a[i] / 6.0, w->constant[STOP][i]);
        int inside = w->constant[LOW][i] <= middle && middle <= w->constant[HIGH][i];
        double xi = inside ? middle / length : 1.0;
        w->h[i] = h;
        w->rest[i] = steps > 1.0 ? left - h : 0.0;
        w->xi[i] = xi;
        w->xi4[i] = (xi * xi) * (xi * xi);
        w->inside[i] = inside ? 1.0 : 0.0;
    }
}

static void modes(Lanes *w, int n, const double *table, int terms) {
    for (int j = 0; j < COLUMNS; j++) {
        double *row = w->series[j];
        for (int i = 0; i < n; i++) row[i] = table[(terms - 1) * COLUMNS + j];
        for (int m = terms - 5; m >= 0; m -= 4) {
            const double *t = table + m * COLUMNS + j;
            double a = t[0], b = t[COLUMNS], c = t[2 * COLUMNS], d = t[3 * COLUMNS];
            for (int i = 0; i < n; i++) {
                double z = w->xi4[i];
                row[i] = (((row[i] * z + d) * z + c) * z + b) * z + a;
            }
        }
    }
}

#define POWERS(k) (w->series[k][i] + xi * w->series[k + 1][i] + xi * xi * w->series[k + 2][i])
#define LINE(k) (w->series[k][i] + xi * w->series[k + 1][i])

static void rotate(Lanes *w, int n) {
    for (int i = 0; i < n; i++) {
        double h = w->h[i], xi = w->xi[i], rho = w->constant[DENSITY][i];
        double ka = w->constant[STIFFNESS][i], length = w->constant[LENGTH][i];
        double ei = w->constant[BENDING][i] / (length * length * length * length);
        double fifth = w->xi4[i] * xi;
        double g11 = fifth * POWERS(0), g12 = fifth * POWERS(3), g22 = fifth * POWERS(6);
        double k11 = ei * (xi * POWERS(9)) + ka * g11;
        double k12 = ei * (xi * POWERS(12)) + ka * g12;
        double k22 = ei * (xi * POWERS(15)) + ka * g22;
        double l11 = sqrt(rho * g11), l21 = rho * g12 / l11, l22 = sqrt(rho * g22 - l21 * l21);
        double i11 = 1.0 / l11, i22 = 1.0 / l22, ratio = l21 * i11;
        double b11 = k11 * i11 * i11, b12 = (k12 - ratio * k11) * i11 * i22;
        double b22 = (k22 - 2.0 * ratio * k12 + ratio * ratio * k11) * i22 * i22;
        double tau = (b22 - b11) / (2.0 * b12);
        double tangent = (tau >= 0.0 ? 1.0 : -1.0) / (fabs(tau) + sqrt(1.0 + tau * tau));
        double cj = 1.0 / sqrt(1.0 + tangent * tangent), sj = tangent * cj;
        double square1 = b11 - tangent * b12, square2 = b22 + tangent * b12;
        double omega1 = sqrt(square1), omega2 = sqrt(square2);
        double v1 = w->z1[i] * i11, v2 = (w->z2[i] - l21 * v1) * i22;
        double y1 = l11 * w->q1[i] + l21 * w->q2[i], y2 = l22 * w->q2[i];
        double x = 0.5 * h * w->constant[DAMPING][i] / rho, mean, ramp;
        decay_means(x, &mean, &ramp);
        double decay = 1.0 - x * mean, sin1, cos1, sin2, cos2;
        sine_cosine(omega1 * h, &sin1, &cos1);
        sine_cosine(omega2 * h, &sin2, &cos2);
        double a1 = cj * y1 - sj * y2, a2 = sj * y1 + cj * y2;
        double b1 = (cj * v1 - sj * v2) * decay, b2 = (sj * v1 + cj * v2) * decay;
        double e1 = a1 * cos1 + b1 * sin1 / omega1, f1 = b1 * cos1 - a1 * omega1 * sin1;
        double e2 = a2 * cos2 + b2 * sin2 / omega2, f2 = b2 * cos2 - a2 * omega2 * sin2;
        double twice1 = (b1 * b1 + square1 * a1 * a1) * h;
        double twice2 = (b2 * b2 + square2 * a2 * a2) * h;
        double change1 = e1 * f1 - a1 * b1, change2 = e2 * f2 - a2 * b2;
        double aa1 = 0.5 * (twice1 - change1) / square1, bb1 = 0.5 * (twice1 + change1);
        double aa2 = 0.5 * (twice2 - change2) / square2, bb2 = 0.5 * (twice2 + change2);
        double change12 = e1 * f2 - a1 * b2, change21 = e2 * f1 - a2 * b1;
        double gap = 1.0 / (square1 - square2);
        double aa12 = (change12 - change21) * gap;
        double bb12 = (square1 * change12 - square2 * change21) * gap;
        double w1 = xi * xi * LINE(18) * i11, w2 = (xi * xi * LINE(20) - l21 * w1) * i22;
        double n1 = cj * w1 - sj * w2, n2 = sj * w1 + cj * w2;
        w1 = LINE(22) * i11, w2 = (LINE(24) - l21 * w1) * i22;
        double m1 = cj * w1 - sj * w2, m2 = sj * w1 + cj * w2;
        double elastic = (ei * m1 * m1 + ka * n1 * n1) * aa1 + (ei * m2 * m2 + ka * n2 * n2) * aa2
            + 2.0 * (ei * m1 * m2 + ka * n1 * n2) * aa12;
        double inertial = rho * (n1 * n1 * bb1 + n2 * n2 * bb2 + 2.0 * n1 * n2 * bb12);
        double t1 = f1 * decay, t2 = f2 * decay;
        double end1 = cj * e1 + sj * e2, end2 = cj * e2 - sj * e1;
        v1 = cj * t1 + sj * t2, v2 = cj * t2 - sj * t1;
        double q2 = end2 * i22;
        w->new_q1[i] = (end1 - l21 * q2) * i11;
        w->new_q2[i] = q2;
        w->new_z1[i] = l11 * v1;
        w->new_z2[i] = l21 * v1 + l22 * v2;
        w->impulse[i] = 0.5 * (elastic - inertial) / length;
    }
}

static void glide(double u, double a, double b, double t, double *end, double *way) {
    double x = b * t, mean = 1.0 - x * (0.5 - x / 6.0), ramp = 0.5 - x * (1.0 / 6.0 - x / 24.0);
    if (x >= 1e-4) mean = -expm1(-x) / x, ramp = (1.0 - mean) / x;
    *end = u * (1.0 - x * mean) + a * t * mean;
    *way = t * (u * mean + a * t * ramp);
}

static void slide(double u, double drive, double mass, double coulomb, double viscous, double t,
                  double withdrawal, double *end, double *way) {
    double distance = 0.0, none;
    if (u != 0.0) {
        double sign = u > 0.0 ? 1.0 : -1.0, factor = u > 0.0 ? 1.0 : withdrawal;
        double b = factor * viscous / mass, braking = (factor * coulomb - drive * sign) / mass;
        double stop = INFINITY;
        if (braking > 0.0) {
            stop = fabs(u) / braking;
            if (b * stop > 1e-16) stop = log1p(b * stop) / b;
        }
        if (stop > t) {
            glide(u, -sign * braking, b, t, end, way);
            return;
        }
        glide(u, -sign * braking, b, stop, &none, &distance);
        t -= stop;
    }
    if (-withdrawal * coulomb <= drive && drive <= coulomb) {
        *end = 0.0, *way = distance;
        return;
    }
    double factor = drive > 0.0 ? 1.0 : withdrawal;
    double excess = drive > 0.0 ? drive - coulomb : drive + factor * coulomb;
    glide(0.0, excess / mass, factor * viscous / mass, t, end, way);
    *way += distance;
}

static void move(Lanes *w, int n) {
    for (int i = 0; i < n; i++) {
        double h = w->h[i], u = w->u[i], mass = w->constant[MASS][i], mean, ramp;
        double sign = u > 0.0 ? 1.0 : -1.0, factor = u > 0.0 ? 1.0 : w->constant[WITHDRAWAL][i];
        double drive = w->force[i] - w->impulse[i] / h;
        double a = (drive - sign * factor * w->constant[COULOMB][i]) / mass;
        double x = factor * w->constant[VISCOUS][i] / mass * h;
        decay_means(x, &mean, &ramp);
        double end = u * (1.0 - x * mean) + a * h * mean;
        w->new_u[i] = end;
        w->travel[i] = h * (u * mean + a * h * ramp);
        w->stops[i] = end * u <= 0.0 ? 1.0 : 0.0;
    }
    for (int i = 0; i < n; i++)
        if (w->stops[i] != 0.0)
            slide(w->u[i], w->force[i] - w->impulse[i] / w->h[i], w->constant[MASS][i],
                  w->constant[COULOMB][i], w->constant[VISCOUS][i], w->h[i],
                  w->constant[WITHDRAWAL][i], &w->new_u[i], &w->travel[i]);
}

static void end(Lanes *w, int n) {
    for (int i = 0; i < n; i++) {
        double depth = w->s[i] + w->travel[i], velocity = w->new_u[i];
        int stopped = depth >= w->constant[STOP][i];
        double high = stopped ? INFINITY : w->constant[HIGH][i];
        int inside = w->inside[i] != 0.0 && w->constant[LOW][i] <= depth && depth <= high;
        w->a[i] = (velocity - w->u[i]) / w->h[i];
        w->inside[i] = inside ? 1.0 : 0.0;
        w->s[i] = inside ? (stopped ? w->constant[STOP][i] : depth) : w->s[i];
        w->u[i] = inside ? (stopped ? 0.0 : velocity) : w->u[i];
        w->q1[i] = inside ? w->new_q1[i] : w->q1[i];
        w->q2[i] = inside ? w->new_q2[i] : w->q2[i];
        w->z1[i] = inside ? w->new_z1[i] : w->z1[i];
        w->z2[i] = inside ? w->new_z2[i] : w->z2[i];
        w->left[i] = w->rest[i];
    }
}

static void gram(const double *table, int terms, double xi, double *g) {
    double z = xi * xi * xi * xi;
    g[0] = g[1] = g[2] = 0.0;
    for (int m = terms - 1; m >= 0; m--)
        for (int k = 0; k < 3; k++) {
            const double *t = table + m * COLUMNS + 3 * k;
            g[k] = g[k] * z + (t[0] + xi * (t[1] + xi * t[2]));
        }
    for (int k = 0; k < 3; k++) g[k] *= z * xi;
}

static void load(Lanes *w, int i, const double *needle, const double *x, const double *table,
                 int terms, double force, double duration) {
    double g[3], rho = needle[DENSITY];
    for (int k = 0; k < CONSTANTS; k++) w->constant[k][i] = needle[k];
    w->s[i] = needle[LENGTH] - x[0], w->u[i] = -x[4], w->a[i] = 0.0;
    gram(table, terms, w->s[i] / needle[LENGTH], g);
    w->q1[i] = x[2], w->q2[i] = x[3];
    w->z1[i] = rho * (g[0] * x[6] + g[1] * x[7]), w->z2[i] = rho * (g[1] * x[6] + g[2] * x[7]);
    w->force[i] = force, w->left[i] = duration, w->inside[i] = 1.0;
}

static void save(const Lanes *w, int i, const double *table, int terms, double *x) {
    double g[3], rho = w->constant[DENSITY][i], length = w->constant[LENGTH][i];
    gram(table, terms, w->s[i] / length, g);
    double l11 = sqrt(rho * g[0]), l21 = rho * g[1] / l11, l22 = sqrt(rho * g[2] - l21 * l21);
    double v1 = w->z1[i] / l11, rate2 = (w->z2[i] - l21 * v1) / (l22 * l22);
    x[0] = length - w->s[i], x[2] = w->q1[i], x[3] = w->q2[i];
    x[4] = -w->u[i], x[6] = (v1 - l21 * rate2) / l11, x[7] = rate2;
}

// Advance runs by a duration [s]; needles (runs, 19), table (terms, 26), states (runs, 8).
void run(const double *needles, const double *table, int terms, int runs, double force,
         double duration, double longest, double *states) {
    Lanes lanes, *w = &lanes;
    int which[LANES], waiting = 0, n = 0;
    memset(w, 0, sizeof lanes);
    for (;;) {
        while (n < LANES && waiting < runs) {
            load(w, n, needles + waiting * CONSTANTS, states + 8 * waiting, table, terms, force,
                 duration);
            which[n++] = waiting++;
        }
        if (n == 0) return;
        begin(w, n, longest);
        modes(w, n, table, terms);
        rotate(w, n);
        move(w, n);
        end(w, n);
        for (int i = n - 1; i >= 0; i--) {
            if (w->inside[i] != 0.0 && w->left[i] != 0.0) continue;
            if (w->inside[i] != 0.0) save(w, i, table, terms, states + 8 * which[i]);
            n--;
            which[i] = which[n];
            for (Row *row = w->constant; row < &w->h; row++) (*row)[i] = (*row)[n];
        }
    }
}
