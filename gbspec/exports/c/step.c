/* One step of length h from t; `u` has the inputs at the method's nodes, node by node. */
void PREFIX_step(const PREFIX_parameters *p, double t, double h, const double *u, double *x) {
    double k[STAGES][PREFIX_STATES], place[PREFIX_STATES], sum;
    int q, r, i;
    for (q = 0; q < STAGES; q++) {
        for (i = 0; i < PREFIX_STATES; i++) {
            sum = 0.0;
            for (r = 0; r < q; r++)
                if (A[q * STAGES + r] != 0.0) sum += A[q * STAGES + r] * k[r][i];
            place[i] = x[i] + h * sum;
        }
        PREFIX_rhs(p, t + C[q] * h, place, WIDTH ? u + AT[q] * WIDTH : NULL, k[q]);
    }
    for (i = 0; i < PREFIX_STATES; i++) {
        sum = 0.0;
        for (r = 0; r < STAGES; r++)
            if (B[r] != 0.0) sum += B[r] * k[r][i];
        x[i] += h * sum;
    }
}

#if DELAYS
int PREFIX_move(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
                double *x, PREFIX_past *past) {
    double u[PREFIX_NODES * WIDTH];
    PREFIX_piece step;
    int q, i, j;
    for (q = 0; q < PREFIX_NODES; q++) {
        for (j = 0; j < PREFIX_INPUTS; j++) u[q * WIDTH + j] = value[j] + slope[j] * (t + NODE[q] * h - begin);
        PREFIX_late(p, past, t + NODE[q] * h, t + 0.5 * h, u + q * WIDTH + PREFIX_INPUTS);
    }
    step.t = t;
    step.h = h;
    for (i = 0; i < PREFIX_STATES; i++) step.x0[i] = x[i];
    PREFIX_rhs(p, t, x, u, step.f0);
    PREFIX_step(p, t, h, u, x);
    for (i = 0; i < PREFIX_STATES; i++) step.x1[i] = x[i];
    PREFIX_rhs(p, t + h, x, u + (PREFIX_NODES - 1) * WIDTH, step.f1);
    for (j = 0; j < PREFIX_INPUTS; j++) {
        step.u0[j] = u[j];
        step.u1[j] = u[(PREFIX_NODES - 1) * WIDTH + j];
    }
    return PREFIX_keep(p, &step, past);
}
#else
void PREFIX_move(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
                 double *x) {
    double u[PREFIX_NODES * PREFIX_INPUTS + 1];
    int q, j;
    u[PREFIX_NODES * PREFIX_INPUTS] = 0.0; /* for models without inputs */
    for (q = 0; q < PREFIX_NODES; q++)
        for (j = 0; j < PREFIX_INPUTS; j++)
            u[q * PREFIX_INPUTS + j] = value[j] + slope[j] * (t + NODE[q] * h - begin);
    PREFIX_step(p, t, h, u, x);
}
#endif
