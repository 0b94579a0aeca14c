% A scan by trajectory over the twin's wire in MATLAB (R2020b or later), no flexdt.
%
%   trajectory                            % the twin on this computer
%   trajectory('192.168.1.7', 55000, 'mine')
%
% Submits one pose a view, waits for the job and prints the data set's folder, which
% `flexdt reconstruct FOLDER --out volume.tif` turns into a volume: dark and flat are in it. Not run
% by the tests: no MATLAB there; its lines on the wire are (tests/clients/test_wire_examples.py).
function trajectory(host, port, name)
    if nargin < 1, host = '127.0.0.1'; end
    if nargin < 2, port = 55000; end
    if nargin < 3, name = 'by-trajectory'; end
    twin = tcpclient(host, port, 'Timeout', 60);
    configureTerminator(twin, 'LF');

    call(twin, 'session.hello', struct('protocol', '1.0', 'client', 'MATLAB'));
    call(twin, 'sample.set', struct('name', 'normal-5'));
    call(twin, 'camera.set', struct('mode', 'HW4SW1High'));
    views = 24;
    angles = num2cell((0:views - 1) * 360 / views);
    poses = struct('rot_obj', angles, 'mag_obj', 600, 'tra_obj', 0);   % one struct a pose
    % flat is true if it is left out: the server moves the sample beside the beam and back, on a
    % path without a contact. A pose instead says where the beam is free; false takes no flat.
    job = call(twin, 'trajectory.submit', struct('poses', {poses}, 'exposure_ms', 20, 'name', name));

    status = call(twin, 'job.status', struct('job', job.job));
    while any(strcmp(status.state, {'queued', 'running', 'paused'}))
        pause(0.2);
        status = call(twin, 'job.status', struct('job', job.job));
    end
    fprintf('%s: %d of %d projections\n', status.state, status.frames_done, status.frames_total);
    disp(job.dataset);
end

function result = call(twin, method, params)
% Send a request and return its result, passing over events; errors become MATLAB errors.
    persistent count
    if isempty(count), count = 0; end
    count = count + 1;
    request = struct('jsonrpc', '2.0', 'id', count, 'method', method, 'params', params);
    writeline(twin, jsonencode(request));
    while true
        answer = jsondecode(readline(twin));
        if isfield(answer, 'method'), continue, end          % an event
        if isfield(answer, 'error')
            error('flexdt:refused', '%s: %s (%d)', method, answer.error.message, answer.error.code);
        end
        result = answer.result;
        return
    end
end
